"""Vector quantisation: vectors are replaced by the nearest of a few learned ones.

A latent has P parts of L numbers, and each part has M codes of its own.
"""

import chex
import jax
import jax.numpy as jnp
from jax import Array


def nearest_codes(latent: Array, codebook: Array) -> Array:
    """Returns the index of each part's nearest code, the first if several are.

        k_p = argmin_m |z_p - c_pm|^2 = argmin_m |c_pm|^2 - 2 <z_p, c_pm>

    Args:
      latent: z. Shape [B, P, L].
      codebook: c. Shape [P, M, L].

    Returns:
      k in {0, ..., M - 1}, int32 [B, P].

    Source: van den Oord et al. 2017, arXiv:1711.00937, eq. (1).
    """
    chex.assert_rank([latent, codebook], 3)
    chex.assert_equal(latent.shape[1], codebook.shape[0])
    chex.assert_equal_shape_suffix([latent, codebook], 1)
    products = jnp.einsum("bpl,pml->bpm", latent, codebook)
    lengths = jnp.sum(jnp.square(codebook), axis=-1)
    return jnp.argmin(lengths[None] - 2.0 * products, axis=-1)


def look_up(indices: Array, codebook: Array) -> Array:
    """Returns the codes at these indices: [B, P], [P, M, L] to [B, P, L].

    Only codes that are looked up get a gradient.

    Source: van den Oord et al. 2017, arXiv:1711.00937, eq. (2).
    """
    chex.assert_rank([indices, codebook], [2, 3])
    chex.assert_equal(indices.shape[1], len(codebook))
    return codebook[jnp.arange(len(codebook))[None], indices]


def straight_through(latent: Array, code: Array) -> Array:
    """Returns the code, with the gradient of the latent; shapes [B, P, L].

        z + stop(c - z)

    Source: van den Oord et al. 2017, arXiv:1711.00937, sec. 3.2.
    """
    chex.assert_rank([latent, code], 3)
    chex.assert_equal_shape([latent, code])
    return latent + jax.lax.stop_gradient(code - latent)


def codebook_loss(latent: Array, code: Array) -> Array:
    """Returns the mean squared distance that moves codes towards their latents.

        L = mean (stop(z) - c)^2

    Shapes [B, P, L].

    Source: van den Oord et al. 2017, arXiv:1711.00937, eq. (3), second term.
    """
    chex.assert_rank([latent, code], 3)
    chex.assert_equal_shape([latent, code])
    return jnp.mean(jnp.square(jax.lax.stop_gradient(latent) - code))


def commitment_loss(latent: Array, code: Array) -> Array:
    """Returns the mean squared distance that moves latents towards their codes.

        L = mean (z - stop(c))^2

    Shapes [B, P, L].

    Source: van den Oord et al. 2017, arXiv:1711.00937, eq. (3), third term.
    """
    chex.assert_rank([latent, code], 3)
    chex.assert_equal_shape([latent, code])
    return jnp.mean(jnp.square(latent - jax.lax.stop_gradient(code)))


def perplexity(indices: Array, *, num_codes: int) -> Array:
    """Returns the effective number of codes in use, in [1, M], as the mean over parts.

        mean_p exp(-sum_m f_pm log f_pm),   f_pm = share of code m among B indices

    of indices [B, P] and M = `num_codes`.
    """
    chex.assert_rank(indices, 2)
    share = jnp.mean(jax.nn.one_hot(indices, num_codes), axis=0)
    entropy = -jnp.sum(jax.scipy.special.xlogy(share, share), axis=-1)
    return jnp.mean(jnp.exp(entropy))
