"""From a config to the functions of an agent."""

import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil.training import agent


def test_the_learning_rate_is_constant_by_default():
    assert agent.learning_rate(jaxil_config.default_config()) == 1e-4


@pytest.mark.parametrize(
    ("num_updates", "expected"), [(0, 4e-4), (25, 3e-4), (100, 0.0), (999, 0.0)]
)
def test_its_steps_are_the_agents_and_not_updates(num_updates, expected):
    config = jaxil_config.default_config()
    config.learning_rate, config.learning_rate_end = 4e-4, 0.0
    config.learning_rate_steps, config.update_every_steps = 200, 2
    schedule = agent.learning_rate(config)
    assert callable(schedule)
    np.testing.assert_allclose(schedule(num_updates), expected, rtol=1e-6, atol=1e-9)
