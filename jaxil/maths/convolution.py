"""Convolutions computed by XLA. For CPUs see also `native.encoding`."""

import chex
import jax.numpy as jnp
from jax import Array, lax


def convolve(images: Array, kernel: Array, stride: int) -> Array:
    """Returns a VALID convolution.

        y[i, j, f] = sum_{u,v,c} x[s i + u, s j + v, c] k[u, v, c, f]

    Maps [B, H, W, C] and [h, w, C, F] to [B, (H - h) // s + 1, (W - w) // s + 1, F].
    """
    chex.assert_rank([images, kernel], 4)
    numbers = ("NHWC", "HWIO", "NHWC")
    strides = (stride, stride)
    return lax.conv_general_dilated(
        images, kernel, strides, "VALID", dimension_numbers=numbers
    )


def convolve_by_windows(images: Array, kernel: Array, stride: int) -> Array:
    """Returns what `convolve` does, as a matrix product with every window.

    For penalties on pixels, which differentiate it twice: on a CPU a discriminator's
    step then takes a half to two thirds less time. It holds all windows in memory
    (GAIfO's step at the paper's sizes: 2.2 GiB in place of 0.9), so other devices
    convolve as above.
    """
    chex.assert_rank([images, kernel], 4)
    return lax.platform_dependent(
        images,
        kernel,
        cpu=lambda x, k: _multiply_windows(x, k, stride),
        default=lambda x, k: convolve(x, k, stride),
    )


def _multiply_windows(images: Array, kernel: Array, stride: int) -> Array:
    x = _windows(images, kernel.shape[:2], stride)
    matrix = kernel.reshape(x.shape[3], -1)
    y = jnp.matmul(x.reshape(-1, x.shape[3]), matrix)
    return y.reshape(*x.shape[:3], -1)


def _windows(images: Array, size: tuple[int, ...], stride: int) -> Array:
    """Maps [B, H, W, C] to windows [B, H', W', h w C]."""
    batch, *sides, channels = images.shape
    height, width = size
    rows, columns = ((n - k) // stride + 1 for n, k in zip(sides, size, strict=True))
    if height == width == stride:  # they do not overlap: a transpose is enough
        seen = images[:, : rows * stride, : columns * stride]
        tiles = seen.reshape(batch, rows, stride, columns, stride, channels)
        return tiles.transpose(0, 1, 3, 2, 4, 5).reshape(batch, rows, columns, -1)
    row_ends, column_ends = (rows - 1) * stride + 1, (columns - 1) * stride + 1
    shifted = [
        images[:, u : u + row_ends : stride, v : v + column_ends : stride]
        for u in range(height)
        for v in range(width)
    ]
    return jnp.concatenate(shifted, axis=3)
