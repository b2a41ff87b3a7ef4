"""Random shifts of images."""

import chex
import jax
import jax.numpy as jnp
from jax import Array


def augment(observation: Array, key: Array, *, padding: int) -> Array:
    """Shifts pixels [B, H, W, C] by `random_shift`; leaves states [B, S] unchanged."""
    chex.assert_rank(observation, {2, 4})
    if observation.ndim == 2:
        return observation
    return random_shift(observation, key, padding=padding)


def augment_pair(
    first: Array, second: Array, key: Array, *, padding: int
) -> tuple[Array, Array]:
    """Shifts two consecutive observations alike, so that motion is preserved.

    Args:
      first: o_t. Shape [B, H, W, C], or [B, S].
      second: o_{t+1}, like `first`.
      key: consumed.
      padding: see `random_shift`.
    """
    chex.assert_equal_shape([first, second])
    both = augment(jnp.concatenate([first, second], axis=-1), key, padding=padding)
    first, second = jnp.split(both, 2, axis=-1)
    return first, second


def random_shift(images: Array, key: Array, *, padding: int) -> Array:
    """Shifts each image by whole pixels, repeating the border.

    Every image is padded by `padding` pixels of its own edge and cropped to its
    original size at a corner sampled uniformly from {0, ..., 2 * padding}^2, the same
    for all its channels. DrQ-v2 interpolates bilinearly, but its sampling points fall
    on pixel centres, so the crop is the same up to rounding.

    Args:
      images: any dtype. Shape [B, H, W, C].
      key: consumed.
      padding: largest shift in pixels.

    Source: Yarats et al. 2021, arXiv:2107.09645, sec. 3.1.
    """
    chex.assert_rank(images, 4)
    if padding == 0:
        return images
    batch, height, width, _ = images.shape
    corners = jax.random.randint(key, (batch, 2), 0, 2 * padding + 1)
    # Clipping the source indices pads the edges without a padded copy.
    shifts = corners - padding
    rows = jnp.clip(jnp.arange(height)[None] + shifts[:, :1], 0, height - 1)
    columns = jnp.clip(jnp.arange(width)[None] + shifts[:, 1:], 0, width - 1)
    indices = jnp.arange(batch)[:, None, None], rows[:, :, None], columns[:, None, :]
    return jnp.asarray(images).at[indices].get(mode="promise_in_bounds")
