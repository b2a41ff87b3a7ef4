"""Discriminators between expert and agent: on features, or on pixels."""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.networks.layers import MLP, Trunk


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
    """Separate encoder and trunk, from observations to a few bounded features."""

    encoder: Any
    feature_dim: int

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        """Maps [B, H, W, C] to [B, D], in [-1, 1]."""
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
        """Maps [B, H, W, C] and [B, A] to logits [B]."""
        features = Embedding(self.encoder, self.feature_dim)(observation)
        inputs = jnp.concatenate([features, action], axis=-1)
        return Discriminator(self.hidden_dim)(inputs)
