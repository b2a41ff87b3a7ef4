"""Convolution with ReLU, in two forms: XLA's, and our own for CPUs in convolution.c."""

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

# Our own takes features by two vectors of a processor; no CPU's vectors are longer.
NATIVE_FEATURES = 32


def convolve_relu(
    images: Array, kernel: Array, bias: Array, stride: int, *, native: bool = False
) -> Array:
    """Returns the ReLU of a VALID convolution.

        y[i, j, f] = max(0, b[f] + sum_{u,v,c} x[s i + u, s j + v, c] k[u, v, c, f])

    Args:
      images: shape [B, H, W, C].
      kernel: shape [h, w, C, F].
      bias: shape [F].
      stride: s, along H and W.
      native: whether our own form computes it where it can, which is for float32 and F
        a multiple of 32; `jaxil.native` has to be loaded. It can be differentiated
        once; XLA's form any number of times.

    Returns:
      Shape [B, (H - h) // s + 1, (W - w) // s + 1, F].
    """
    chex.assert_rank([images, kernel, bias], [4, 4, 1])
    chex.assert_equal(bias.shape[0], kernel.shape[3])
    fits = kernel.shape[3] % NATIVE_FEATURES == 0
    if native and fits and images.dtype == jnp.float32:
        return _NATIVE(stride, images, kernel, bias)
    return jax.nn.relu(_XLA(stride, images, kernel) + bias[None, None, None])


def _plain(stride: int, images: Array, kernel: Array) -> Array:
    numbers = ("NHWC", "HWIO", "NHWC")
    strides = (stride, stride)
    return lax.conv_general_dilated(
        images, kernel, strides, "VALID", dimension_numbers=numbers
    )


def _forward(
    stride: int, images: Array, kernel: Array
) -> tuple[Array, tuple[Array, Array]]:
    return _XLA(stride, images, kernel), (images, kernel)


def _backward(
    stride: int, saved: tuple[Array, Array], cotangent: Array
) -> tuple[Array, Array]:
    images, kernel = saved
    _, to_both = jax.vjp(functools.partial(_plain, stride), images, kernel)
    image_gradient, kernel_gradient = to_both(cotangent)
    if kernel.shape[:2] == (stride, stride):
        # A penalty on pixels differentiates this once more: XLA's own form of that
        # takes a fifth of DAC's update on a CPU.
        image_gradient = tile_gradient(cotangent, kernel, images.shape[1:3])
    return image_gradient, kernel_gradient


_XLA: Any = jax.custom_vjp(_plain, nondiff_argnums=(0,))
_XLA.defvjp(_forward, _backward)


def tile_gradient(cotangent: Array, kernel: Array, size: tuple[int, ...]) -> Array:
    """Returns what a cotangent of a convolution of tiles means for the images.

        dx[h i + u, w j + v] = k[u, v] dy[i, j]

    No two windows overlap, so nothing is summed but the features.

    Args:
      cotangent: shape [B, H // h, W // w, F].
      kernel: shape [h, w, C, F].
      size: H and W; what no window reaches gets 0.

    Returns:
      Shape [B, H, W, C].
    """
    chex.assert_rank([cotangent, kernel], 4)
    tiles = jnp.einsum("bijf,uvcf->biujvc", cotangent, kernel)
    batch, rows, height, columns, width, channels = tiles.shape
    seen = tiles.reshape(batch, rows * height, columns * width, channels)
    unseen = [
        (0, full - used) for full, used in zip(size, seen.shape[1:3], strict=True)
    ]
    return jnp.pad(seen, [(0, 0), *unseen, (0, 0)])


class _Saved(NamedTuple):
    """What the gradients of our own form need; y tells where ReLU let pass."""

    images: Array
    kernel: Array
    y: Array


def _native(stride: int, images: Array, kernel: Array, bias: Array) -> Array:
    height, width = (
        (n - k) // stride + 1 for n, k in zip(images.shape[1:3], kernel.shape)
    )
    y = _array(images.shape[0], height, width, kernel.shape[3])
    return _call("jaxil_convolve_relu", y, stride, images, kernel, bias)


def _native_forward(
    stride: int, images: Array, kernel: Array, bias: Array
) -> tuple[Array, _Saved]:
    y = _native(stride, images, kernel, bias)
    return y, _Saved(images, kernel, y)


def _native_backward(
    stride: int, saved: _Saved, cotangent: Array
) -> tuple[Array, Array, Array]:
    images, kernel, y = saved
    gradients = _array(*kernel.shape), _array(kernel.shape[3])
    kernel_gradient, bias_gradient = _call(
        "jaxil_kernel_gradient", gradients, stride, images, y, cotangent
    )
    if stride == 1 and kernel.shape[2] % NATIVE_FEATURES == 0:
        image_gradient = _call(
            "jaxil_image_gradient", _array(*images.shape), stride, kernel, y, cotangent
        )
    else:  # an encoder's first layer, whose images nobody asks the gradient of
        _, to_images = jax.vjp(lambda x: _plain(stride, x, kernel), images)
        (image_gradient,) = to_images(jnp.where(y > 0, cotangent, 0.0))
    return image_gradient, kernel_gradient, bias_gradient


_NATIVE: Any = jax.custom_vjp(_native, nondiff_argnums=(0,))
_NATIVE.defvjp(_native_forward, _native_backward)


def _array(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _call(name: str, results: Any, stride: int, *arguments: Array) -> Any:
    """Calls a function of convolution.c."""
    call = jax.ffi.ffi_call(name, results, vmap_method="sequential")
    return call(*arguments, stride=np.int64(stride))
