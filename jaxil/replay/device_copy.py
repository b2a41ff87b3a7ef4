"""A device copy of the replay's frames, so that batches are sent as indices.

Checkpoints are still written from the NumPy ring.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.replay.replay import Replay

# All writes have this size, so that they compile once; 1.4 MB of the paper's frames.
_BLOCK_FRAMES = 64


class DeviceCopy:
    """Holds the frames of a replay in one array on jax's default device.

    Attributes:
      frames: equals `Replay.frames` wherever an episode is stored. Each `refresh`
        replaces and deletes it, so do not keep it.
    """

    def __init__(self, replay: Replay, *, block_frames: int = _BLOCK_FRAMES) -> None:
        """Copies a replay, which must not be cleared from now on."""
        self._replay = replay
        self._block_frames = min(block_frames, len(replay.frames))
        self._num_episodes = 0
        self.frames = jnp.zeros(replay.frames.shape, replay.frames.dtype)
        self.refresh()

    def refresh(self) -> None:
        """Copies the episodes that were added since the last call."""
        ring, size = self._replay.frames, self._block_frames
        for index in self._replay.episodes:
            if index < self._num_episodes:
                continue
            # Whole blocks of the ring, with frames that are unchanged.
            for block in np.unique(self._replay.slots(index) // size):
                first = min(block * size, len(ring) - size)
                # A copy, since jax may still read it after the ring has changed.
                frames = np.array(ring[first : first + size])
                self.frames = _write(self.frames, frames, np.int32(first))
        self._num_episodes = self._replay.num_episodes_added


# Donating the array makes XLA write to it in place.
@functools.partial(jax.jit, donate_argnums=0)
def _write(frames: jax.Array, block: jax.Array, first: jax.Array) -> jax.Array:
    return jax.lax.dynamic_update_slice_in_dim(frames, block, first, axis=0)
