"""Convolution with ReLU, computed by XLA. For CPUs see also `native.encoding`."""

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import Array, lax


def convolve_relu(images: Array, kernel: Array, bias: Array, stride: int) -> Array:
    """Returns the ReLU of a VALID convolution.

        y[i, j, f] = max(0, b[f] + sum_{u,v,c} x[s i + u, s j + v, c] k[u, v, c, f])

    Maps [B, H, W, C] to [B, (H - h) // s + 1, (W - w) // s + 1, F].
    """
    chex.assert_rank([images, kernel, bias], [4, 4, 1])
    chex.assert_equal(bias.shape[0], kernel.shape[3])
    return jax.nn.relu(_CONVOLVE(stride, images, kernel) + bias[None, None, None])


def _plain(stride: int, images: Array, kernel: Array) -> Array:
    numbers = ("NHWC", "HWIO", "NHWC")
    strides = (stride, stride)
    return lax.conv_general_dilated(
        images, kernel, strides, "VALID", dimension_numbers=numbers
    )


def _forward(
    stride: int, images: Array, kernel: Array
) -> tuple[Array, tuple[Array, Array]]:
    return _CONVOLVE(stride, images, kernel), (images, kernel)


def _backward(
    stride: int, saved: tuple[Array, Array], cotangent: Array
) -> tuple[Array, Array]:
    images, kernel = saved
    _, to_both = jax.vjp(functools.partial(_plain, stride), images, kernel)
    image_gradient, kernel_gradient = to_both(cotangent)
    if kernel.shape[:2] == (stride, stride):
        # The gradient penalty on pixels differentiates this again. On a CPU that would
        # take a fifth of DAC's update with XLA's own gradient.
        image_gradient = tile_gradient(cotangent, kernel, images.shape[1:3])
    return image_gradient, kernel_gradient


_CONVOLVE: Any = jax.custom_vjp(_plain, nondiff_argnums=(0,))
_CONVOLVE.defvjp(_forward, _backward)


def tile_gradient(cotangent: Array, kernel: Array, size: tuple[int, ...]) -> Array:
    """Returns the image gradient of a convolution whose windows do not overlap.

        dx[h i + u, w j + v] = k[u, v] dy[i, j]

    Maps [B, H // h, W // w, F] to [B, H, W, C] with H, W = `size`; pixels outside all
    windows get 0.
    """
    chex.assert_rank([cotangent, kernel], 4)
    tiles = jnp.einsum("bijf,uvcf->biujvc", cotangent, kernel)
    batch, rows, height, columns, width, channels = tiles.shape
    seen = tiles.reshape(batch, rows * height, columns * width, channels)
    unseen = [
        (0, full - used) for full, used in zip(size, seen.shape[1:3], strict=True)
    ]
    return jnp.pad(seen, [(0, 0), *unseen, (0, 0)])
