"""Convolution with gradients in the form that a processor computes fastest."""

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import Array, lax

_LAYOUT = ("NHWC", "HWIO", "NHWC")


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
    its place in a flax layer. The value is XLA's own; so are the gradients, up to
    the order of summation, but on CPUs XLA takes two to three times as long for the
    kernel's (see `kernel_gradient`), and minutes for both inside a loop.

    Args:
      images: shape [B, H, W, C].
      kernel: shape [h, w, C, F].
      strides: along H and W.
      padding: "VALID".
      lhs_dilation: none.
      rhs_dilation: none.
      dimension_numbers: that of channels-last images.
      feature_group_count: 1.
      precision: none.

    Returns:
      Shape [B, (H - h) // stride + 1, (W - w) // stride + 1, F].

    Raises:
      ValueError: another convolution is asked for.
    """
    chex.assert_rank([images, kernel], 4)
    layout = lax.conv_dimension_numbers(images.shape, kernel.shape, _LAYOUT)
    plain = (
        padding == "VALID"
        and set(lhs_dilation or [1]) == set(rhs_dilation or [1]) == {1}
        and dimension_numbers in (None, _LAYOUT, layout)
        and feature_group_count == 1
        and precision is None
    )
    if not plain:
        raise ValueError(
            "only VALID convolutions of channels-last images are computed here, "
            "without dilation, groups or precision; take jax.lax.conv_general_dilated"
        )
    return _convolve(tuple(strides), images, kernel)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _convolve(strides: tuple[int, int], images: Array, kernel: Array) -> Array:
    return lax.conv_general_dilated(
        images, kernel, strides, "VALID", dimension_numbers=_LAYOUT
    )


def _forward(
    strides: tuple[int, int], images: Array, kernel: Array
) -> tuple[Array, tuple[Array, Array]]:
    return _convolve(strides, images, kernel), (images, kernel)


def _backward(
    strides: tuple[int, int], saved: tuple[Array, Array], cotangent: Array
) -> tuple[Array, Array]:
    images, kernel = saved
    return (
        image_gradient(cotangent, kernel, strides, images.shape[1:3]),
        kernel_gradient(images, cotangent, strides, kernel.shape[:2]),
    )


_convolve.defvjp(_forward, _backward)


def image_gradient(
    cotangent: Array, kernel: Array, strides: tuple[int, int], size: tuple[int, ...]
) -> Array:
    """Returns what a cotangent of the value means for the images.

        dx[i] = sum_{i = s i' + u} k[u]^T dy[i']

    Args:
      cotangent: shape [B, H', W', F].
      kernel: shape [h, w, C, F].
      strides: along H and W.
      size: H and W.

    Returns:
      Shape [B, H, W, C].
    """
    chex.assert_rank([cotangent, kernel], 4)
    if tuple(kernel.shape[:2]) == tuple(strides):
        # No two windows overlap, so nothing is summed but the features.
        apart = jnp.einsum("bijf,uvcf->biujvc", cotangent, kernel)
        batch, rows, height, columns, width, channels = apart.shape
        seen = apart.reshape(batch, rows * height, columns * width, channels)
        unseen = [
            (0, full - used) for full, used in zip(size, seen.shape[1:3], strict=True)
        ]
        return jnp.pad(seen, [(0, 0), *unseen, (0, 0)])
    padding = [
        (window - 1, full - ((reduced - 1) * stride + 1))
        for window, full, reduced, stride in zip(
            kernel.shape, size, cotangent.shape[1:3], strides
        )
    ]
    return lax.conv_general_dilated(
        cotangent,
        jnp.swapaxes(jnp.flip(kernel, (0, 1)), 2, 3),
        (1, 1),
        padding,
        lhs_dilation=strides,
        dimension_numbers=_LAYOUT,
    )


def kernel_gradient(
    images: Array,
    cotangent: Array,
    strides: tuple[int, int],
    window: tuple[int, ...],
) -> Array:
    """Returns what a cotangent of the value means for the kernel.

        dk[u, v] = sum_{b, i, j} x[b, s i + u, s j + v] dy[b, i, j]^T

    As h products of the transposed cotangent with the w * C numbers in a row of each
    window: products whose long, summed axis is the last of the left side and the
    first of the right one run at nearly the processor's full rate, XLA's own form
    and the transposed product at a third of it.

    Args:
      images: shape [B, H, W, C].
      cotangent: shape [B, H', W', F].
      strides: along H and W.
      window: h and w.

    Returns:
      Shape [h, w, C, F].
    """
    chex.assert_rank([images, cotangent], 4)
    _, rows, columns, features = cotangent.shape
    # Without these barriers XLA takes the transpositions into the product.
    left = lax.optimization_barrier(cotangent.reshape(-1, features).T)
    row_windows = jnp.concatenate(
        [
            images[:, :, v : v + strides[1] * (columns - 1) + 1 : strides[1]]
            for v in range(window[1])
        ],
        axis=-1,
    )
    products = [
        left
        @ row_windows[:, u : u + strides[0] * (rows - 1) + 1 : strides[0]].reshape(
            -1, row_windows.shape[-1]
        )
        for u in range(window[0])
    ]
    together = lax.optimization_barrier(jnp.stack(products))  # [h, F, w * C]
    return jnp.swapaxes(together, 1, 2).reshape(*window, -1, features)
