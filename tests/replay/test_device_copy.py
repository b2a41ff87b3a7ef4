"""Frames on the device against the ring, and stacks made there against NumPy's."""

from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.learner.gathering import gather_batch, gather_expert
from jaxil.maths.types import ExpertBatch
from jaxil.replay import device_copy
from jaxil.replay.device_copy import DeviceCopy
from jaxil.replay.replay import Replay

CAPACITY, EPISODE, BATCH = 24, 6, 16
GATHER = jax.jit(gather_batch)  # few shapes: each one is compiled


def make_replay(pixels: bool) -> Replay:
    return Replay(
        capacity_steps=CAPACITY,
        episode_steps=EPISODE,
        observation_shape=(3, 2, 3) if pixels else (5,),
        observation_dtype=np.uint8 if pixels else np.float32,
        action_dim=2,
        frame_stack=3 if pixels else 1,
        num_steps=2,
        discount_factor=0.9,
    )


def add_episode(replay: Replay, num_steps: int, rng: np.random.Generator) -> None:
    shape = (num_steps + 1, *replay.frames.shape[1:])
    replay.add_episode(
        frames=rng.integers(0, 256, shape).astype(replay.frames.dtype),
        actions=rng.normal(size=(num_steps, 2)),
        rewards=rng.normal(size=num_steps),
        discounts=np.ones(num_steps),
    )


def stored_slots(replay: Replay) -> np.ndarray:
    return np.concatenate([replay.slots(number) for number in replay.episodes])


@settings(deadline=None, max_examples=60)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=12),
    pixels=st.booleans(),
    windows=st.booleans(),
    block_frames=st.sampled_from([1, 7, 1000]),
    refreshed=st.sampled_from([1, 2, 20]),
    seed=st.integers(0, 2**32 - 1),
)
def test_stacks_from_the_device_are_those_of_the_host(
    lengths, pixels, windows, block_frames, refreshed, seed
):
    rng = np.random.default_rng(seed)
    replay = make_replay(pixels)
    copy = DeviceCopy(replay, block_frames=block_frames)
    for number, length in enumerate(lengths):
        add_episode(replay, length, rng)
        if number % refreshed == 0:  # some see many episodes at once, some lost ones
            copy.refresh()
    copy.refresh()
    slots = stored_slots(replay)
    np.testing.assert_array_equal(copy.frames[slots], replay.frames[slots])
    if not replay.can_sample():
        return
    whole, indices = (
        replay.sample(np.random.default_rng(seed), BATCH, windows=windows, as_indices=x)
        for x in (False, True)
    )
    assert indices.observation.dtype == np.int32
    gathered = GATHER(copy.frames, indices)
    leaves = jax.tree.leaves(gathered), jax.tree.leaves(whole)
    for ours, theirs in zip(*leaves, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


def test_expert_frames_lie_end_to_end():
    frames = np.arange(2 * 4 * 3, dtype=np.float32).reshape(2, 4, 3)
    drawn = ExpertBatch(np.array([[5], [0]], np.int32), np.zeros((2, 0)))
    # Index 5 is the second frame of the second episode.
    expected = [frames[1, 1], frames[0, 0]]
    np.testing.assert_array_equal(gather_expert(frames, drawn).observation, expected)


def test_a_copy_of_a_filled_replay_and_its_one_compilation():
    rng, replay = np.random.default_rng(0), make_replay(True)
    for length in (6, 6, 6, 6, 5):
        add_episode(replay, length, rng)
    write: Any = device_copy._write
    write.clear_cache()
    copy = DeviceCopy(replay, block_frames=4)  # 28 slots, the last block overlaps none
    for length in (1, 9, 4):
        add_episode(replay, length, rng)
        copy.refresh()
    slots = stored_slots(replay)
    np.testing.assert_array_equal(copy.frames[slots], replay.frames[slots])
    assert write._cache_size() == 1


def test_the_ring_may_change_while_a_block_travels():
    rng, replay = np.random.default_rng(0), make_replay(True)
    add_episode(replay, 6, rng)
    copy = DeviceCopy(replay)
    before = np.array(copy.frames[:7])
    add_episode(replay, 6, rng)
    for _ in range(3):  # over the first episode's slots, without telling the copy
        add_episode(replay, 8, rng)
    np.testing.assert_array_equal(copy.frames[:7], before)


def test_the_ring_can_t_be_written_through_the_property():
    frames = make_replay(True).frames
    with pytest.raises(ValueError, match="read-only"):
        frames[0] = 0
