"""Stacks of frames against their plain definition."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.maths.stacking import gather_stacks, stack_frames


@pytest.mark.parametrize(
    ("num_frames", "frame_stack", "trailing"),
    [(6, 3, (2, 3, 3)), (2, 4, (5,)), (1, 2, (5,)), (4, 1, (2, 3, 3))],
)
def test_stacks_are_the_past_clipped_at_the_start(num_frames, frame_stack, trailing):
    frames = np.arange(num_frames * np.prod(trailing), dtype=np.int32)
    frames = frames.reshape(num_frames, *trailing)
    stacks = np.asarray(stack_frames(jnp.asarray(frames), frame_stack=frame_stack))
    width = trailing[-1]
    assert stacks.shape == (num_frames, *trailing[:-1], frame_stack * width)
    for t in range(num_frames):
        for position in range(frame_stack):  # the newest is the last
            source = max(t - (frame_stack - 1 - position), 0)
            np.testing.assert_array_equal(
                stacks[t, ..., position * width : (position + 1) * width],
                frames[source],
            )


def test_channels_by_hand():
    # Frame number n has the channels 10 n, 10 n + 1, 10 n + 2.
    frames = 10 * np.arange(4)[:, None, None, None] + np.arange(3)
    stacks = gather_stacks(frames.astype(np.uint8), np.array([[0, 0, 1], [1, 2, 3]]))
    assert stacks.shape == (2, 1, 1, 9)
    assert stacks[0, 0, 0].tolist() == [0, 1, 2, 0, 1, 2, 10, 11, 12]
    assert stacks[1, 0, 0].tolist() == [10, 11, 12, 20, 21, 22, 30, 31, 32]
