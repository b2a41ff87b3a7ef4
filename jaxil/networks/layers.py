"""Building blocks that several networks share."""

import math
from typing import Any

import chex
import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.maths import convolution, products
from jaxil.native.encoding import Weights

_LAYER_NORM_EPSILON = 1e-5  # PyTorch's default; flax's own is 1e-6


def dense(features: int, name: str | None = None, dtype: Any = jnp.float32) -> nn.Dense:
    """Returns a linear layer, orthogonal with gain 1 and bias 0.

    Args:
      features: size of the output.
      name: of its parameters.
      dtype: of the product; parameters are float32 whatever it is.

    Source: facebookresearch/drqv2, utils.py, `weight_init`.
    """
    return nn.Dense(
        features,
        kernel_init=nn.initializers.orthogonal(),
        name=name,
        dtype=dtype,
        dot_general=products.dot_general,
    )


class ConvolutionReLU(nn.Module):
    """A VALID convolution with ReLU, orthogonal with the gain of ReLU, and bias 0.

    Attributes:
      features: F, output channels.
      kernel_size: side of the square kernel.
      stride: along both sides.
      dtype: of the convolution; parameters are float32 whatever it is.

    Source: facebookresearch/drqv2, utils.py, `weight_init`.
    """

    features: int
    kernel_size: int
    stride: int
    dtype: Any = jnp.float32

    @nn.compact
    def weights(self, channels: int) -> Weights:
        """Returns the parameters for images of so many channels."""
        shape = (self.kernel_size, self.kernel_size, channels, self.features)
        gain = nn.initializers.orthogonal(scale=math.sqrt(2.0))
        kernel = self.param("kernel", gain, shape)
        return Weights(
            kernel, self.param("bias", nn.initializers.zeros, (self.features,))
        )

    def __call__(self, images: Array) -> Array:
        """Maps [B, H, W, C] to [B, H', W', F] of `dtype`."""
        chex.assert_rank(images, 4)
        arrays = (images, *self.weights(images.shape[-1]))
        images, kernel, bias = (x.astype(self.dtype) for x in arrays)
        return convolution.convolve_relu(images, kernel, bias, self.stride)


class Trunk(nn.Module):
    """Squeezes a representation into a few bounded features.

        h = tanh(LayerNorm(W x + b))

    Attributes:
      feature_dim: D, number of features.
      dtype: of the product W x, the learner's largest; the rest is float32.

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
    """Two hidden ReLU layers and a linear output.

    Attributes:
      hidden_dim: width of both hidden layers.
      output_dim: width of the output.
    """

    hidden_dim: int
    output_dim: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps [B, X] to [B, output_dim]."""
        x = nn.relu(dense(self.hidden_dim, name="hidden_1")(x))
        x = nn.relu(dense(self.hidden_dim, name="hidden_2")(x))
        return dense(self.output_dim, name="output")(x)
