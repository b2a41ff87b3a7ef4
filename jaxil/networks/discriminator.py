"""Discriminators between expert and agent: on features, or on pixels."""

from typing import Any

import chex
import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.networks.layers import MLP, Convolution, Trunk


class Discriminator(nn.Module):
    """MLP from features (and actions, if the method sees them) to one logit.

    Source: siddhanthaldar/ROT, agent/dac.py; the paper does not describe it.
    """

    hidden_dim: int

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """Maps [B, D] to logits [B], positive for the expert."""
        return MLP(self.hidden_dim, 1)(inputs)[:, 0]


class Embedding(nn.Module):
    """Encoder and trunk of a network that is separate from the agent's."""

    encoder: Any
    feature_dim: int

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        """Maps [B, H, W, C] or [B, S] to [B, D], in [-1, 1]."""
        return Trunk(self.feature_dim)(self.encoder(observation))


class PixelDiscriminator(nn.Module):
    """Discriminator of pixels and actions, separate from the agent's networks.

    Source: Cohen et al. 2021, sec. 4.1, the DAC baseline; same sizes as the agent.
    """

    encoder: Any
    feature_dim: int
    hidden_dim: int

    @nn.compact
    def __call__(self, observation: Array, action: Array) -> Array:
        """Maps [B, H, W, C] or [B, S], and [B, A], to logits [B]."""
        features = Embedding(self.encoder, self.feature_dim)(observation)
        inputs = jnp.concatenate([features, action], axis=-1)
        return Discriminator(self.hidden_dim)(inputs)


class TransitionDiscriminator(nn.Module):
    """Discriminator of two consecutive observations, embedded by the same encoder."""

    encoder: Any
    feature_dim: int
    hidden_dim: int

    @nn.compact
    def __call__(self, observation: Array, successor: Array) -> Array:
        """Maps two arrays [B, H, W, C] or [B, S] to logits [B]."""
        embed = Embedding(self.encoder, self.feature_dim)
        features = [embed(observation), embed(successor)]
        return Discriminator(self.hidden_dim)(jnp.concatenate(features, axis=-1))


class PatchDiscriminator(nn.Module):
    """Convolutions to one logit for each patch of 22x22 pixels, 2 pixels apart.

    Attributes:
      width: channels of the first layer; 32 in PatchAIL.
      by_windows: see `Convolution`.

    Source: sail-sg/PatchAIL, agent/discriminator.py.
    """

    width: int
    by_windows: bool = False

    @nn.compact
    def __call__(self, pixels: Array) -> Array:
        """Maps pixels in [0, 1], [B, H, W, C], to logits [B, P]."""
        chex.assert_rank(pixels, 4)
        x = pixels - 0.5
        layers = (self.width, 2), (2 * self.width, 1), (4 * self.width, 1), (1, 1)
        for number, (features, stride) in enumerate(layers):
            x = nn.leaky_relu(x, 0.2) if number else x
            x = Convolution(
                features,
                kernel_size=4,
                stride=stride,
                padding=1,
                by_windows=self.by_windows,
                name=f"Conv_{number}",
            )(x)
        return x.reshape(len(x), -1)
