"""Frame stacks and random shifts: what happens to pixels before the encoder."""

import chex
import jax
import jax.numpy as jnp
from jax import Array


def stack_frames(frames: Array, *, frame_stack: int) -> Array:
    """Returns each frame with those before it, oldest first.

        o_t = [f_{t-n+1}, ..., f_t]   with   f_{-i} = f_0

    so a stack never reaches past the start of its episode.

    Args:
      frames: one episode. Shape [T, H, W, C], or [T, S] for state vectors.
      frame_stack: n, number of frames in a stack, at least 1.

    Returns:
      Stacks, folded into the last axis. Shape [T, H, W, n * C] or [T, n * S].

    Source: Yarats et al. 2021, arXiv:2107.09645, sec. 3.1.
    """
    chex.assert_rank(frames, {2, 4})
    times = jnp.arange(frames.shape[0])
    past = [
        frames[jnp.maximum(times - age, 0)] for age in range(frame_stack - 1, -1, -1)
    ]
    return jnp.concatenate(past, axis=-1)


def augment(observation: Array, key: Array, *, padding: int) -> Array:
    """Shifts pixels [B, H, W, C], see `random_shift`; leaves states [B, S] alone."""
    chex.assert_rank(observation, {2, 4})
    if observation.ndim == 2:
        return observation
    return random_shift(observation, key, padding=padding)


def random_shift(images: Array, key: Array, *, padding: int) -> Array:
    """Shifts each image by whole pixels, repeating the border.

    Every image is padded by `padding` pixels of its own edge and cropped back to
    its size at a corner drawn uniformly from {0, ..., 2 * padding}^2; all channels
    of an image move together. DrQ-v2 interpolates bilinearly, but its sampling
    points fall on pixel centres, so the crop is the same up to rounding.

    Args:
      images: any dtype. Shape [B, H, W, C].
      key: consumed.
      padding: largest shift in pixels; 0 leaves the images alone.

    Returns:
      Shifted images of the same shape and dtype.

    Source: Yarats et al. 2021, arXiv:2107.09645, sec. 3.1.
    """
    chex.assert_rank(images, 4)
    if padding == 0:
        return images
    batch, height, width, _ = images.shape
    corners = jax.random.randint(key, (batch, 2), 0, 2 * padding + 1)
    # Clipped source indices are edge padding without the padded copy.
    shifts = corners - padding
    rows = jnp.clip(jnp.arange(height)[None] + shifts[:, :1], 0, height - 1)
    columns = jnp.clip(jnp.arange(width)[None] + shifts[:, 1:], 0, width - 1)
    places = (
        jnp.arange(batch)[:, None, None],
        rows[:, :, None],
        columns[:, None, :],
    )
    return jnp.asarray(images).at[places].get(mode="promise_in_bounds")
