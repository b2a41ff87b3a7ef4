"""Encoders of the observation, which actor and critic share."""

from typing import Any

import chex
import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.native import encoding
from jaxil.networks.layers import Convolution, dense


class PixelEncoder(nn.Module):
    """A stack of VALID convolutions with ReLU, flattened.

        x = contrast * (pixels / 255 - mean)

    Attributes:
      channels, kernel_sizes, strides: of each layer.
      contrast: factor on the centred pixels; 1 in the paper.
      mean: in [0, 1]: 0.5 in the paper, or an image [H, W, C] as nested tuples or an
        array.
      dtype: of the convolutions; parameters are always float32.
      native: whether `encoding.encode` is used for uint8 pixels. It supports float32,
        channels in multiples of 32, and first derivatives.
      by_windows: see `Convolution`; `native` goes before it.

    Source: facebookresearch/drqv2, drqv2.py, `Encoder`.
    """

    channels: tuple[int, ...] = (32, 32, 32, 32)
    kernel_sizes: tuple[int, ...] = (3, 3, 3, 3)
    strides: tuple[int, ...] = (2, 1, 1, 1)
    contrast: float = 1.0
    mean: Any = 0.5
    dtype: Any = jnp.float32
    native: bool = False
    by_windows: bool = False

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        """Maps uint8 [B, H, W, C] to [B, R] of `dtype`."""
        chex.assert_rank(observation, 4)
        mean = jnp.asarray(self.mean, jnp.float32)
        settings = zip(self.channels, self.kernel_sizes, self.strides, strict=True)
        layers = [
            Convolution(
                *each, dtype=self.dtype, by_windows=self.by_windows, name=f"Conv_{k}"
            )
            for k, each in enumerate(settings)
        ]
        if self.native and observation.dtype == jnp.uint8:
            inputs = (observation.shape[-1], *self.channels)
            weights = [layer.weights(c) for layer, c in zip(layers, inputs)]
            x = encoding.encode(
                observation,
                mean,
                weights,
                contrast=self.contrast,
                strides=self.strides,
            )
        else:
            x = observation.astype(jnp.float32) / 255.0
            x = self.contrast * (x - (mean[None] if mean.ndim else mean))
            for layer in layers:
                x = nn.relu(layer(x))
        return x.reshape(x.shape[0], -1)


class StateEncoder(nn.Module):
    """One hidden layer for state vectors, used to train experts.

        x = relu(W sign(s) log(1 + |s|) + b)

    Without it the trunk's LayerNorm would remove the scale of the state, such as
    whether a joint turns at 10 or at 20 rad/s. The logarithm is there because
    velocities are an order of magnitude larger than positions.
    """

    hidden_dim: int

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        """Maps [B, S] to [B, R]."""
        chex.assert_rank(observation, 2)
        s = observation.astype(jnp.float32)
        return nn.relu(dense(self.hidden_dim)(jnp.sign(s) * jnp.log1p(jnp.abs(s))))
