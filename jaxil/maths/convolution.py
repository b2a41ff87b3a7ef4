"""Strided convolution in the form that this processor computes fastest."""

from typing import Any

import chex
import jax
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
    XLA's gradient of a strided convolution is slow on CPUs: those become matrix
    products, of tiles where windows do not overlap, of gathered patches where they
    do. Value and gradient are the same up to the order of summation.

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
    if tuple(kernel.shape[:2]) == tuple(strides):
        return convolve_tiles(images, kernel)
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
    _, height, width, _ = images.shape
    rows = (height - window[0]) // strides[0] + 1
    columns = (width - window[1]) // strides[1] + 1
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


@jax.custom_vjp
def convolve_tiles(images: Array, kernel: Array) -> Array:
    """Returns the convolution whose strides are its kernel's sides.

    A row of a window lies in one piece in memory, so the images need no copy: only
    the h rows of a window are summed over, beside the w * C numbers in each.

    Args:
      images: shape [B, H, W, C].
      kernel: shape [h, w, C, F].

    Returns:
      Shape [B, H // h, W // w, F].
    """
    return jnp.einsum("brydc,ycf->brdf", _tiles(images, kernel), _row_kernel(kernel))


def _tiles(images: Array, kernel: Array) -> Array:
    """Splits [B, H, W, C] into [B, H // h, h, W // w, w * C], without copying."""
    chex.assert_rank([images, kernel], 4)
    batch, height, width, channels = images.shape
    rows, columns = height // kernel.shape[0], width // kernel.shape[1]
    used = images[:, : rows * kernel.shape[0], : columns * kernel.shape[1]]
    return used.reshape(
        batch, rows, kernel.shape[0], columns, kernel.shape[1] * channels
    )


def _row_kernel(kernel: Array) -> Array:
    return kernel.reshape(kernel.shape[0], -1, kernel.shape[-1])


def _tiles_forward(images: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return convolve_tiles(images, kernel), (images, kernel)


def _tiles_backward(
    saved: tuple[Array, Array], cotangent: Array
) -> tuple[Array, Array]:
    images, kernel = saved
    tiles = _tiles(images, kernel)
    batch, rows, height, columns, depth = tiles.shape
    # For the kernel XLA's own gradient is the fastest, once a row is one pixel.
    as_pixels = tiles.reshape(batch, rows * height, columns, depth)
    numbers = lax.conv_dimension_numbers(
        as_pixels.shape, (height, 1, depth, kernel.shape[-1]), ("NHWC", "HWIO", "NHWC")
    )
    _, transpose = jax.vjp(
        lambda flat: lax.conv_general_dilated(
            as_pixels, flat, (height, 1), "VALID", dimension_numbers=numbers
        ),
        kernel.reshape(height, 1, depth, -1),
    )
    (kernel_gradient,) = transpose(cotangent)
    image_gradient = jnp.einsum("brdf,ycf->brydc", cotangent, _row_kernel(kernel))
    image_gradient = image_gradient.reshape(
        batch, rows * height, columns * kernel.shape[1], images.shape[-1]
    )
    unused = [
        (0, whole - part)
        for whole, part in zip(images.shape, image_gradient.shape, strict=True)
    ]
    return jnp.pad(image_gradient, unused), kernel_gradient.reshape(kernel.shape)


convolve_tiles.defvjp(_tiles_forward, _tiles_backward)
