"""BCO: its inverse model sees actions in the video, and the policy copies them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.learner.policy import make_mean_action
from jaxil.rewarders import bco
from tests.rewarders.small_world import (
    demonstrations,
    expert_actions,
    learner_of,
    pictures,
    play,
    record_shifts,
    state_of,
)
from tests.tiny_agent import make_episode, random_frames

SETTINGS = {"batch_size": 32, "std": 0.1, "hidden_dim": 32, "learning_rate": 3e-3}


@functools.cache
def make_learner(observation="state", shift_padding=0):
    return learner_of(bco.make_rewarder, observation, shift_padding, SETTINGS)


@functools.cache
def make_step(observation="state", shift_padding=0):
    learner = make_learner(observation, shift_padding)
    return jax.jit(bco.make_update_step(learner, **SETTINGS))


def make_state(observation="state", shift_padding=0):
    return state_of(make_learner(observation, shift_padding), observation)


def test_the_policy_copies_actions_that_nobody_told_it():
    rng, state, step = np.random.default_rng(0), make_state(), make_step()
    before = make_state()
    for _ in range(1000):
        state, metrics = step(state, play(rng), demonstrations(rng))
    assert metrics["inverse_model/error"] < 0.02  # of a mean square of 0.67
    seen = demonstrations(rng).observation
    copied = make_mean_action(make_learner().networks)(
        state.encoder.params, state.actor.params, seen
    )
    error = np.mean(np.square(copied - expert_actions(seen)))
    assert error < 0.1 * np.mean(np.square(expert_actions(seen)))
    assert int(state.num_updates) == 1000
    for name in ("critic", "target_critic"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(state, name), getattr(before, name)
        )


def test_the_inverse_model_learns_from_the_agent_alone():
    """Other demonstrations change the policy, and nothing of the inverse model."""
    batch, step = play(np.random.default_rng(0)), make_step()
    one, _ = step(make_state(), batch, demonstrations(np.random.default_rng(1)))
    other, _ = step(make_state(), batch, demonstrations(np.random.default_rng(2)))
    jax.tree.map(np.testing.assert_array_equal, one.rewarder, other.rewarder)
    different = jax.tree.map(
        lambda x, y: bool(np.any(x != y)), one.actor.params, other.actor.params
    )
    assert any(jax.tree.leaves(different))


def test_both_observations_of_a_pair_are_shifted_alike(monkeypatch):
    """If nothing moves, the inverse model must see that nothing moves."""
    seen = record_shifts(monkeypatch)
    batch, expert = pictures()
    step = bco.make_update_step(make_learner("pixels", 2), **SETTINGS)
    step(make_state("pixels", 2), batch, expert)
    pair = next(x for x in seen if x.shape[-1] == 6)
    np.testing.assert_array_equal(pair[..., :3], pair[..., 3:])
    assert np.any(pair[..., :3] != batch.observation)


def test_asks_for_successors_and_refuses_another_number_of_samples():
    rewarder = make_learner().rewarder
    assert rewarder.expert_batch_size == 32
    assert rewarder.samples_successors
    rng = np.random.default_rng(0)
    with pytest.raises(AssertionError):
        make_step()(make_state(), play(rng), demonstrations(rng, size=31))
    with pytest.raises(AssertionError):
        make_step()(make_state(), play(rng)._replace(successor=None), None)


def test_rewards_nothing():
    episode = make_episode(random_frames(0, 6))
    params = make_state().params
    rewards = make_learner().rewarder.rewards((), params, episode, None)
    np.testing.assert_array_equal(rewards, jnp.zeros(5))
