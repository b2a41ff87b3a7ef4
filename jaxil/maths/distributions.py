"""The clipped Gaussian that DrQ-v2 calls a truncated normal."""

import chex
import jax
import jax.numpy as jnp
from jax import Array

_INSIDE = 1e-6  # distance of actions from the bounds of [-1, 1]


def clamp_straight_through(actions: Array) -> Array:
    """Returns actions clamped into the open unit box, with the gradient unchanged.

        a = clip(x, -1 + 1e-6, 1 - 1e-6),   da/dx = 1

    An actor whose noise left the box still learns which direction is better.

    Source: facebookresearch/drqv2, utils.py, `TruncatedNormal._clamp`.
    """
    clamped = jnp.clip(actions, -1.0 + _INSIDE, 1.0 - _INSIDE)
    # x + stop_gradient(clip(x) - x) would round; this is exactly the clipped value.
    return jax.lax.stop_gradient(clamped) + (actions - jax.lax.stop_gradient(actions))


def sample_truncated_normal(
    mean: Array, std: Array, key: Array, *, noise_clip: float | None
) -> Array:
    """Samples actions around a mean.

        a = clamp(mean + clip(std * n, -c, c)),   n ~ Normal(0, 1)

    Args:
      mean: in [-1, 1]. Shape [..., A].
      std: shape [].
      key: consumed.
      noise_clip: c; None does not clip the noise (acting).

    Source: Yarats et al. 2021, arXiv:2107.09645, eqs. (1) and (2).
    """
    chex.assert_rank(std, 0)
    noise = std * jax.random.normal(key, mean.shape, mean.dtype)
    if noise_clip is not None:
        noise = jnp.clip(noise, -noise_clip, noise_clip)
    return clamp_straight_through(mean + noise)
