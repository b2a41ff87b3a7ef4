"""From a config to the functions of an agent."""

import re
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil import methods
from jaxil.networks.layers import orthogonal
from jaxil.training import agent
from tests.training.drawing import Drawing, make_config, make_demonstrations


def test_the_learning_rate_is_constant_by_default():
    assert agent.learning_rate(jaxil_config.default_config()) == 1e-4


@pytest.mark.parametrize("at_once", [1, 3])
@pytest.mark.parametrize(
    ("num_updates", "expected"), [(0, 4e-4), (25, 3e-4), (100, 0.0), (999, 0.0)]
)
def test_its_steps_are_the_agents_and_not_updates(num_updates, expected, at_once):
    config = jaxil_config.default_config()
    config.learning_rate, config.learning_rate_end = 4e-4, 0.0
    config.learning_rate_steps, config.update_every_steps = 200, 2
    config.updates_per_step = at_once
    num_updates *= at_once
    schedule = agent.learning_rate(config)
    assert callable(schedule)
    np.testing.assert_allclose(schedule(num_updates), expected, rtol=1e-6, atol=1e-9)


def test_its_longest_schedule_can_be_counted():
    config = jaxil_config.default_config()
    config.learning_rate_end, config.learning_rate_steps = 0.0, 10**9
    config.update_every_steps, config.updates_per_step = 1, 100
    schedule = agent.learning_rate(config)
    assert callable(schedule)
    np.testing.assert_allclose(schedule(np.int32(2**30)), 5e-5, rtol=1e-6)


@pytest.mark.parametrize(("every", "at_once"), [(2, 1), (1, 1), (1, 4)])
def test_updates_draw_the_noise_of_their_agent_step(every, at_once):
    config = jaxil_config.default_config()
    config.seed_frames, config.action_repeat = 40, 2
    config.exploration_std_start, config.exploration_std_end = 1.0, 0.1
    config.exploration_std_steps = 100
    config.update_every_steps, config.updates_per_step = every, at_once
    by_step = agent.exploration_schedule(config)
    by_update = agent.exploration_by_update(config)
    for step in (0, 8, 40, 500):  # after the first update
        num_updates = step // every * at_once
        np.testing.assert_allclose(by_update(num_updates), by_step(20 + step))


@pytest.mark.parametrize("method", methods.known())
def test_no_first_weights_are_factorised_in_batches(method):
    """Two batches at once waited for each other for ever on two cores."""
    environment: Any = Drawing()
    made = agent.make_agent(make_config(method), environment, make_demonstrations())
    lowered = made.init_state.lower().as_text()
    assert set(re.findall(r'num_batch_dims = "(\d)"', lowered)) == {"0"}


def test_several_networks_get_the_weights_that_each_would_get_alone():
    keys = jax.random.split(jax.random.key(0), 3)
    drawn = jax.vmap(lambda key: orthogonal(2.0)(key, (5, 4)))(keys)
    for key, weights in zip(keys, drawn, strict=True):
        alone = nn.initializers.orthogonal(2.0)(key, (5, 4))
        np.testing.assert_array_equal(weights, alone)
        np.testing.assert_allclose(weights.T @ weights, 4.0 * np.eye(4), atol=1e-5)
