"""Stacks of frames, put together where they are needed."""

import concurrent.futures
import os

import numpy as np

# Interleaving is memory traffic: it goes in blocks that stay in a core's cache, and
# only more bytes than the second number are worth handing to other threads.
_BLOCK_BYTES = 2**21
_PARALLEL_BYTES = 2**22
_THREADS = concurrent.futures.ThreadPoolExecutor(
    min(4, os.cpu_count() or 1), thread_name_prefix="stacking"
)


def gather_stacks(frames: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Gathers frames and folds each stack of them into the channels.

    Args:
      frames: [N, H, W, C], or [N, S] if K is 1.
      indices: [B, K] numbers in [0, N): the frames of each stack, the oldest first.

    Returns:
      A fresh array [B, H, W, K * C], or [B, S], in C order.
    """
    batch_size, num_stacked = indices.shape
    if num_stacked == 1:
        return frames[indices[:, 0]]
    height, width, channels = frames.shape[1:]
    pixels = frames.reshape(len(frames), height * width, channels)
    stacks = np.empty(
        (batch_size, height * width, num_stacked * channels), frames.dtype
    )

    def fill(block: slice) -> None:
        for place in range(num_stacked):
            gathered = pixels[indices[block, place]]
            # One strided copy for each channel: NumPy's inner loop then runs along
            # the pixels. Copying whole pixels makes inner loops of C bytes (4 times
            # slower).
            for channel in range(channels):
                stacks[block, :, place * channels + channel] = gathered[:, :, channel]

    size = max(1, _BLOCK_BYTES // max(1, stacks[:1].nbytes))
    blocks = [slice(first, first + size) for first in range(0, batch_size, size)]
    if stacks.nbytes > _PARALLEL_BYTES:
        list(_THREADS.map(fill, blocks))
    else:
        for block in blocks:
            fill(block)
    return stacks.reshape(batch_size, height, width, num_stacked * channels)
