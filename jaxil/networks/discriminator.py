"""Tells the expert from the agent: on features, or on pixels of its own."""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.networks.layers import MLP, Trunk


class Discriminator(nn.Module):
    """MLP from features (and actions, where the method sees them) to one logit.

    Attributes:
      hidden_dim: width of both hidden layers.

    Source: siddhanthaldar/ROT, agent/dac.py; the paper does not give it.
    """

    hidden_dim: int

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """Maps [B, D] to logits [B], positive where it looks like the expert."""
        return MLP(self.hidden_dim, 1)(inputs)[:, 0]


class Embedding(nn.Module):
    """Observations to a few bounded features, by an encoder and a trunk of its own.

    Attributes:
      encoder: maps [B, H, W, C], or [B, S], to [B, R].
      feature_dim: D.
    """

    encoder: Any
    feature_dim: int

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        """Maps [B, H, W, C] to [B, D], in [-1, 1]."""
        return Trunk(self.feature_dim)(self.encoder(observation))


class PixelDiscriminator(nn.Module):
    """Discriminator of pixels and actions that shares nothing with the agent.

    Attributes:
      encoder: see `Embedding`.
      feature_dim: D.
      hidden_dim: width of both hidden layers.

    Source: Cohen et al. 2021, sec. 4.1, the DAC baseline; its sizes are the agent's.
    """

    encoder: Any
    feature_dim: int
    hidden_dim: int

    @nn.compact
    def __call__(self, observation: Array, action: Array) -> Array:
        """Maps [B, H, W, C] and [B, A] to logits [B]."""
        features = Embedding(self.encoder, self.feature_dim)(observation)
        inputs = jnp.concatenate([features, action], axis=-1)
        return Discriminator(self.hidden_dim)(inputs)
