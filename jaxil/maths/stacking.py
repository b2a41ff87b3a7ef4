"""Stacks of frames, assembled on the device."""

import chex
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxil.maths.types import Data


def gather_stacks(frames: Data, indices: Data) -> Array:
    """Gathers frames and folds each stack of them into the last axis.

    Args:
      frames: shape [N, H, W, C], or [N, S] for states.
      indices: int32 [..., F] in [0, N): the frames of each stack, oldest first.

    Returns:
      Shape [..., H, W, F * C], or [..., F * S].
    """
    chex.assert_rank(frames, {2, 4})
    gathered = jnp.asarray(frames).at[indices].get(mode="promise_in_bounds")
    gathered = jnp.moveaxis(gathered, indices.ndim - 1, -2)
    return gathered.reshape(*gathered.shape[:-2], -1)


def stack_frames(frames: Array, *, frame_stack: int) -> Array:
    """Returns each frame of an episode with those before it, oldest first.

        o_t = [f_{t-n+1}, ..., f_t]   with   f_{-i} = f_0

    Args:
      frames: shape [T, H, W, C], or [T, S] for states.
      frame_stack: n, at least 1.

    Returns:
      Shape [T, H, W, n * C] or [T, n * S].

    Source: Yarats et al. 2021, arXiv:2107.09645, sec. 3.1.
    """
    times = stack_times(np.arange(frames.shape[0]), frame_stack=frame_stack)
    return gather_stacks(frames, times)


def stack_times(times: np.ndarray, *, frame_stack: int) -> np.ndarray:
    """Returns the times of the frames in each o_t, oldest first: [...] to [..., F]."""
    return np.maximum(times[..., None] - np.arange(frame_stack)[::-1], 0)
