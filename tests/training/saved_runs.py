"""Small replays and learners' states, saved, restored and compared."""

import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.replay.replay import Replay
from jaxil.training.checkpoint import Checkpoints


def make_replay(num_episodes: int = 0) -> Replay:
    replay = Replay(
        capacity_steps=12,
        episode_steps=4,
        observation_shape=(4, 4, 3),
        observation_dtype=np.uint8,
        action_dim=2,
        frame_stack=2,
        num_steps=2,
        discount_factor=0.9,
    )
    add_episodes(replay, num_episodes)
    return replay


def add_episodes(replay: Replay, count: int, num_steps: int = 4) -> None:
    for _ in range(count):
        rng = np.random.default_rng(replay.num_episodes_added)
        replay.add_episode(
            frames=rng.integers(0, 256, (num_steps + 1, 4, 4, 3), dtype=np.uint8),
            actions=rng.normal(size=(num_steps, 2)),
            rewards=rng.normal(size=num_steps),
            discounts=np.ones(num_steps),
        )


def make_state(seed: int) -> dict:
    key = jax.random.key(seed)
    return {
        "actor": [{"kernel": jax.random.normal(key, (3, 5))}, None],
        "key": key,
        "keys": jax.random.split(jax.random.key(seed, impl="rbg"), 2),
        "num_updates": jnp.int32(seed),
        "half": jnp.full((2,), 1.5, jnp.bfloat16),
        "empty": jnp.zeros((0, 4)),
        "flag": jnp.array(True),
    }


ABSTRACT = jax.eval_shape(lambda: make_state(0))


def assert_same_state(one, other) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def assert_same_replay(one: Replay, other: Replay) -> None:
    assert one.episodes == other.episodes
    assert one.num_episodes_added == other.num_episodes_added
    for index in one.episodes:
        for a, b in zip(one.episode(index), other.episode(index), strict=True):
            np.testing.assert_array_equal(a, b)


def save(checkpoints, frame: int, replay: Replay, **counters) -> None:
    checkpoints.save(
        frame=frame, learner_state=make_state(frame), counters=counters, replay=replay
    )


class Restored(NamedTuple):
    checkpoints: Checkpoints
    replay: Replay
    state: dict
    counters: dict
    said: list[str]


def restore(folder: pathlib.Path) -> Restored:
    """Restores everything, as a new process does."""
    said, replay = [], make_replay()
    checkpoints = Checkpoints(folder, say=said.append)
    return Restored(checkpoints, replay, *checkpoints.restore(ABSTRACT, replay), said)
