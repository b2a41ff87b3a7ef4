"""Recomputing the rewards of a whole replay."""

import functools

import jax
import numpy as np
import pytest

from jaxil import methods
from jaxil.learner.rewarder import make_refresh
from jaxil.replay.replay import Replay
from tests.tiny_agent import (
    ACTION_DIM,
    SIDE,
    make_agent,
    make_episode,
    make_experts,
    make_params,
    make_spec,
    random_actions,
    random_frames,
)

STEPS, STACK = 4, 2
EXPERTS = make_experts(random_frames(50, 2, STEPS + 1))
PARAMS = make_params(0, STACK)


SETTINGS = {
    "pdac": {
        "hidden_dim": 16,
        "learning_rate": 3e-3,
        "gradient_penalty": 10.0,
        "batch_size": 8,
        "sees_actions": True,
        "num_components": 0,
    },
    "psil": {
        "cost": "cosine",
        "alignment": "transport",
        "epsilon": 0.05,
        "num_iterations": 50,
        "target_update_steps": 20,
        "return_scale": 10.0,
        "num_components": 0,
    },
}


@functools.cache
def make_rewarder(method):
    make = methods.load(method, "make_rewarder")
    rewarder = make(make_agent(STACK), **SETTINGS[method])
    return rewarder._replace(rewards=jax.jit(rewarder.rewards))


@functools.cache
def refresh(method):
    return jax.jit(make_refresh(make_rewarder(method)))


def fill_replay() -> Replay:
    """A ring whose newest episode has overwritten the oldest."""
    replay = Replay(
        capacity_steps=3 * STEPS,
        episode_steps=STEPS,
        observation_shape=(SIDE, SIDE, 3),
        observation_dtype=np.uint8,
        action_dim=ACTION_DIM,
        frame_stack=STACK,
        num_steps=1,
        discount_factor=0.9,
    )
    for seed in range(5):
        actions = random_actions(seed, STEPS)
        episode = make_episode(random_frames(seed, STEPS + 1), actions)
        replay.add_episode(**episode._asdict())
    return replay


def state_after_an_episode(method):
    rewarder = make_rewarder(method)
    spec = make_spec(expert_steps=STEPS, frame_stack=STACK)
    state = rewarder.init(jax.random.key(0), spec, PARAMS)
    experts = EXPERTS if rewarder.matches_episodes else None
    first = make_episode(random_frames(9, STEPS + 1))
    return jax.jit(rewarder.observe)(state, PARAMS, first, experts), experts


@pytest.mark.parametrize("method", ["pdac", "psil"])
def test_refreshed_rewards_are_those_that_each_episode_would_get_now(method):
    replay, (state, experts) = fill_replay(), state_after_an_episode(method)
    slots = np.stack([replay.slots(index) for index in replay.episodes])
    actions = np.stack([replay.actions(index) for index in replay.episodes])
    assert len(slots) == 3
    stored = (actions, np.full(3, STEPS), experts)
    refreshed = refresh(method)(state, PARAMS, replay.frames, slots, *stored)
    for index, rewards in zip(replay.episodes, np.asarray(refreshed), strict=True):
        episode = replay.episode(index)
        expected = make_rewarder(method).rewards(state, PARAMS, episode, experts)
        np.testing.assert_allclose(rewards, expected, rtol=1e-4, atol=1e-6)
        replay.replace_rewards(index, rewards)
        np.testing.assert_array_equal(replay.episode(index).rewards, rewards)
    assert np.ptp(np.sum(refreshed, axis=1)) > 1e-3  # episodes differ
    # From a copy on the host that holds these episodes' frames alone, one by one.
    frames = replay.frames[slots.ravel()]
    indices = np.arange(slots.size).reshape(slots.shape)
    copied = refresh(method)(state, PARAMS, frames, indices, *stored)
    np.testing.assert_allclose(copied, refreshed, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("frames", "indices", "actions", "num_steps"),
    [
        ((8, SIDE, SIDE, 3), (2, STEPS), (2, STEPS, 2), 2),  # no last observation
        ((8, SIDE, SIDE, 3), (2, STEPS + 1), (3, STEPS, 2), 2),  # an episode more
        ((8, SIDE, SIDE, 3), (2, STEPS + 1), (2, STEPS, 2), 3),  # a number more
        ((8, SIDE, SIDE, 3), (STEPS + 1,), (STEPS, 2), 1),  # one episode alone
        ((2, STEPS + 1, SIDE, SIDE, 3), (2, STEPS + 1), (2, STEPS, 2), 2),
    ],
)
def test_refuses_shapes_that_do_not_belong_together(
    frames, indices, actions, num_steps
):
    with pytest.raises(AssertionError):
        make_refresh(make_rewarder("pdac"))(
            None,
            PARAMS,
            np.zeros(frames, np.uint8),
            np.zeros(indices, np.int32),
            np.zeros(actions, np.float32),
            np.full(num_steps, STEPS),
            None,
        )
