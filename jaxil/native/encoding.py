"""The encoder's convolutions in C, for CPUs: all layers, image by image."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

FEATURES = 32  # two of the longest vectors that CPUs have
MOST_LAYERS = 8


class Weights(NamedTuple):
    """The parameters of one layer.

    Attributes:
      kernel: float32 [h, w, C, F], F a multiple of FEATURES.
      bias: float32 [F].
    """

    kernel: Array
    bias: Array


def encode(
    pixels: Array,
    mean: Array,
    weights: Sequence[Weights],
    *,
    contrast: float,
    strides: tuple[int, ...],
) -> Array:
    """Passes pixels through VALID convolutions with ReLU.

        x_0 = contrast (pixels / 255 - mean)
        x_l[i, j, f] = max(0, z[i, j, f])
        z[i, j, f] = b[f] + sum_{u,v,c} x_{l-1}[s i + u, s j + v, c] k[u, v, c, f]

    `native.build` must have loaded the library. Only first derivatives with respect to
    the weights are defined. Kernels of 3x3 with stride 1 use `winograd.h`, which rounds
    differently and spreads non-finite values by a pixel.

    Args:
      pixels: uint8 [B, H, W, C].
      mean: float32 [H, W, C], or a single number of any rank.
      weights: at most MOST_LAYERS.
      contrast: factor on the centred pixels.
      strides: s of each layer.

    Returns:
      The last layer's output, float32 [B, H', W', F].
    """
    chex.assert_rank(pixels, 4)
    chex.assert_type([pixels, mean], [jnp.uint8, jnp.float32])
    chex.assert_equal(len(weights), len(strides))
    assert mean.size == 1 or mean.shape == pixels.shape[1:], mean.shape
    assert 1 <= len(weights) <= MOST_LAYERS, len(weights)
    channels = pixels.shape[3]
    for kernel, bias in weights:
        chex.assert_shape([kernel, bias], [(None, None, channels, None), (None,)])
        chex.assert_equal(kernel.shape[3], bias.shape[0])
        channels = kernel.shape[3]
        assert channels % FEATURES == 0, channels
    settings = _Settings(contrast, strides)
    return _ENCODE(settings, pixels, mean, tuple(weights))


class _Settings(NamedTuple):
    contrast: float
    strides: tuple[int, ...]


def _encode(
    settings: _Settings, pixels: Array, mean: Array, weights: tuple[Weights, ...]
) -> Array:
    (y,) = _outputs(settings, pixels, mean, weights, wanted=1)
    return y


def _forward(
    settings: _Settings, pixels: Array, mean: Array, weights: tuple[Weights, ...]
) -> tuple[Array, tuple]:
    outputs = _outputs(settings, pixels, mean, weights, wanted=len(weights))
    # No need of z: an output is positive where its ReLU was active.
    return outputs[-1], (pixels, mean, weights, outputs)


def _backward(
    settings: _Settings, saved: tuple, cotangent: Array
) -> tuple[None, None, tuple[Weights, ...]]:
    _, _, weights, _ = saved
    shapes = [_array(*leaf.shape) for leaf in jax.tree.leaves(weights)]
    gradients = _call("jaxil_encode_gradient", shapes, settings, saved, cotangent)
    of_layers = zip(gradients[::2], gradients[1::2], strict=True)
    return None, None, tuple(Weights(*layer) for layer in of_layers)


_ENCODE: Any = jax.custom_vjp(_encode, nondiff_argnums=(0,))
_ENCODE.defvjp(_forward, _backward)


def _outputs(
    settings: _Settings,
    pixels: Array,
    mean: Array,
    weights: tuple[Weights, ...],
    *,
    wanted: int,
) -> Sequence[Array]:
    """Returns the outputs of the last `wanted` layers."""
    size, shapes = pixels.shape[1:3], []
    for (kernel, _), stride in zip(weights, settings.strides, strict=True):
        assert all(n >= k for n, k in zip(size, kernel.shape)), (size, kernel.shape)
        size = tuple((n - k) // stride + 1 for n, k in zip(size, kernel.shape))
        shapes.append(_array(pixels.shape[0], *size, kernel.shape[3]))
    return _call("jaxil_encode", shapes[-wanted:], settings, pixels, mean, weights)


def _array(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _call(
    name: str,
    results: Sequence[jax.ShapeDtypeStruct],
    settings: _Settings,
    *arguments: Any,
) -> Sequence[Array]:
    """Calls a function of encoder.c with the leaves of the arguments."""
    call = jax.ffi.ffi_call(name, results, vmap_method="sequential")
    return call(
        *jax.tree.leaves(arguments),
        contrast=np.float32(settings.contrast),
        strides=np.asarray(settings.strides, np.int64),
    )
