"""Layers that several networks share."""

import math
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from jaxil.maths import convolution, products
from jaxil.native.encoding import Weights

_LAYER_NORM_EPSILON = 1e-5  # PyTorch's default; flax's own is 1e-6


def orthogonal(scale: float = 1.0) -> nn.initializers.Initializer:
    """Returns flax's orthogonal initialiser, which draws one matrix after another.

    Under `vmap` flax's would factorise a batch of matrices. For that a thread of XLA's
    pool hands matrices to the pool's other threads and blocks until they are done: on
    two cores two such batches waited for each other for ever (jaxlib 0.10.2, three
    inverse models of width 1024).
    """
    initialise = nn.initializers.orthogonal(scale)

    def draw(key: Array, shape: Any, dtype: Any = jnp.float32) -> Array:
        one = jax.custom_batching.sequential_vmap(lambda k: initialise(k, shape, dtype))
        return one(key)

    return draw


def dense(features: int, name: str | None = None, dtype: Any = jnp.float32) -> nn.Dense:
    """Returns a linear layer with orthogonal initial weights (gain 1) and zero bias.

    `dtype` is that of the product; parameters are always float32.

    Source: facebookresearch/drqv2, utils.py, `weight_init`.
    """
    return nn.Dense(
        features,
        kernel_init=orthogonal(),
        name=name,
        dtype=dtype,
        dot_general=products.dot_general,
    )


class Convolution(nn.Module):
    """A convolution with a square kernel and bias, to be followed by a ReLU.

    Initial weights are orthogonal with the gain of ReLU, biases zero.

    Attributes:
      features, kernel_size, stride: of the kernel.
      padding: zeros on each side of the images.
      dtype: of the convolution; parameters are always float32.
      by_windows: whether `convolution.convolve_by_windows` is used, for penalties.

    Source: facebookresearch/drqv2, utils.py, `weight_init`.
    """

    features: int
    kernel_size: int
    stride: int
    padding: int = 0
    dtype: Any = jnp.float32
    by_windows: bool = False

    @nn.compact
    def weights(self, channels: int) -> Weights:
        """Returns the parameters for images with this number of channels."""
        shape = (self.kernel_size, self.kernel_size, channels, self.features)
        kernel = self.param("kernel", orthogonal(math.sqrt(2.0)), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return Weights(kernel, bias)

    def __call__(self, images: Array) -> Array:
        """Maps [B, H, W, C] to [B, H', W', F] of `dtype`."""
        chex.assert_rank(images, 4)
        arrays = (images, *self.weights(images.shape[-1]))
        images, kernel, bias = (x.astype(self.dtype) for x in arrays)
        sides = [(0, 0), *[(self.padding, self.padding)] * 2, (0, 0)]
        convolve = convolution.convolve
        if self.by_windows:
            convolve = convolution.convolve_by_windows
        return (
            convolve(jnp.pad(images, sides), kernel, self.stride)
            + bias[None, None, None]
        )


class Trunk(nn.Module):
    """Maps a representation to a few bounded features.

        h = tanh(LayerNorm(W x + b))

    `dtype` is that of W x, the learner's largest product; the rest is float32.

    Source: facebookresearch/drqv2, drqv2.py, `Actor.trunk`, `Critic.trunk`.
    """

    feature_dim: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, representation: Array) -> Array:
        """Maps [B, R] to float32 [B, D], in [-1, 1]."""
        chex.assert_rank(representation, 2)
        project = dense(self.feature_dim, name="project", dtype=self.dtype)
        x = project(representation).astype(jnp.float32)
        x = nn.LayerNorm(epsilon=_LAYER_NORM_EPSILON, name="normalise")(x)
        return jnp.tanh(x)


class MLP(nn.Module):
    """Two hidden ReLU layers and a linear output."""

    hidden_dim: int
    output_dim: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps [B, X] to [B, output_dim]."""
        x = nn.relu(dense(self.hidden_dim, name="hidden_1")(x))
        x = nn.relu(dense(self.hidden_dim, name="hidden_2")(x))
        return dense(self.output_dim, name="output")(x)
