"""Stacks of frames, assembled on the host."""

import concurrent.futures
import os

import numpy as np

# Interleaving is bound by memory: a block stays in a core's cache.
_BLOCK_BYTES = 2**21
_PARALLEL_BYTES = 2**22  # more threads help beyond this size only
_THREADS = concurrent.futures.ThreadPoolExecutor(
    min(4, os.cpu_count() or 1), thread_name_prefix="stacking"
)


def gather_stacks(frames: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Gathers frames and folds each stack of them into the channels.

    Args:
      frames: [N, H, W, C], or [N, S] if F is 1.
      indices: [..., F], in [0, N): the frames of each stack, oldest first.

    Returns:
      A new array [..., H, W, F * C], or [..., S], in C order.
    """
    *axes, num_stacked = indices.shape
    if num_stacked == 1:
        return frames[indices[..., 0]]
    indices = indices.reshape(-1, num_stacked)
    batch_size = len(indices)
    height, width, channels = frames.shape[1:]
    pixels = frames.reshape(len(frames), height * width, channels)
    stacks = np.empty(
        (batch_size, height * width, num_stacked * channels), frames.dtype
    )

    def fill(block: slice) -> None:
        for position in range(num_stacked):
            gathered = pixels[indices[block, position]]
            # One strided copy per channel, so that NumPy's inner loop runs along the
            # pixels: 4 times faster than inner loops of C bytes.
            for channel in range(channels):
                stacks[block, :, position * channels + channel] = gathered[
                    :, :, channel
                ]

    size = max(1, _BLOCK_BYTES // max(1, stacks[:1].nbytes))
    blocks = [slice(first, first + size) for first in range(0, batch_size, size)]
    if stacks.nbytes > _PARALLEL_BYTES:
        list(_THREADS.map(fill, blocks))
    else:
        for block in blocks:
            fill(block)
    return stacks.reshape(*axes, height, width, num_stacked * channels)
