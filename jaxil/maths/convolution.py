"""Strided convolution in the form that this processor computes fastest."""

from typing import Any

import chex
import jax.numpy as jnp
from jax import Array, lax


def convolve(
    images: Array,
    kernel: Array,
    strides: tuple[int, int],
    padding: Any,
    *,
    lhs_dilation: Any = None,
    rhs_dilation: Any = None,
    dimension_numbers: Any = None,
    feature_group_count: int = 1,
    precision: Any = None,
) -> Array:
    """Returns the VALID convolution of images with a kernel.

    The signature is that of `jax.lax.conv_general_dilated`, so that it can take
    its place in a flax layer. Strided layers read few channels (the pixels), and
    XLA's gradient of a strided convolution is slow on CPUs: those become one
    matrix product of gathered patches. Value and gradient are the same up to the
    order of summation.

    Args:
      images: shape [B, H, W, C].
      kernel: shape [h, w, C, F].
      strides: along H and W.
      padding: "VALID".
      lhs_dilation: none.
      rhs_dilation: none.
      dimension_numbers: that of channels-last images.
      feature_group_count: 1.
      precision: as in jax.

    Returns:
      Shape [B, (H - h) // stride + 1, (W - w) // stride + 1, F].
    """
    chex.assert_rank([images, kernel], 4)
    if max(strides) == 1:
        return lax.conv_general_dilated(
            images,
            kernel,
            strides,
            padding,
            lhs_dilation=lhs_dilation,
            rhs_dilation=rhs_dilation,
            dimension_numbers=dimension_numbers,
            feature_group_count=feature_group_count,
            precision=precision,
        )
    columns = gather_patches(images, kernel.shape[:2], strides)
    weights = kernel.reshape(-1, kernel.shape[-1])
    return jnp.matmul(columns, weights, precision=precision)


def gather_patches(
    images: Array, window: tuple[int, ...], strides: tuple[int, ...]
) -> Array:
    """Returns each window of the images as one vector, ordered as a kernel is.

    Args:
      images: shape [B, H, W, C].
      window: h and w.
      strides: along H and W.

    Returns:
      Shape [B, H', W', h * w * C] with H' = (H - h) // stride + 1.
    """
    chex.assert_rank(images, 4)
    batch, height, width, channels = images.shape
    rows = (height - window[0]) // strides[0] + 1
    columns = (width - window[1]) // strides[1] + 1
    if tuple(window) == tuple(strides):
        # Windows that do not overlap are a reshape: no pixel is copied twice.
        used = images[:, : rows * window[0], : columns * window[1]]
        tiles = used.reshape(batch, rows, window[0], columns, window[1], channels)
        return tiles.transpose(0, 1, 3, 2, 4, 5).reshape(batch, rows, columns, -1)
    shifted = [
        images[
            :,
            row : row + strides[0] * (rows - 1) + 1 : strides[0],
            column : column + strides[1] * (columns - 1) + 1 : strides[1],
        ]
        for row in range(window[0])
        for column in range(window[1])
    ]
    return jnp.concatenate(shifted, axis=-1)
