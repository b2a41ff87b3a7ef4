"""The inverse model: which action led from one observation to the next."""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.networks.discriminator import Embedding
from jaxil.networks.layers import MLP


class InverseModel(nn.Module):
    """Maps two consecutive observations, embedded by the same encoder, to an action.

    Source: Torabi et al. 2018, arXiv:1805.01954, sec. 4.1, with an encoder and a trunk
    like the agent's in front, since observations are pixels here.
    """

    encoder: Any
    feature_dim: int
    hidden_dim: int
    action_dim: int

    @nn.compact
    def __call__(self, observation: Array, successor: Array) -> Array:
        """Maps two arrays [B, H, W, C] or [B, S] to actions [B, A], in [-1, 1]."""
        embed = Embedding(self.encoder, self.feature_dim)
        features = [embed(observation), embed(successor)]
        mlp = MLP(self.hidden_dim, self.action_dim)
        return jnp.tanh(mlp(jnp.concatenate(features, axis=-1)))


class InverseModels(nn.Module):
    """Several inverse models that share encoder and trunk but have separate heads.

    The heads start from different weights and learn from the same samples, so they
    agree more where samples are many than where they are few.
    """

    encoder: Any
    feature_dim: int
    hidden_dim: int
    action_dim: int
    num_models: int

    @nn.compact
    def __call__(self, observation: Array, successor: Array) -> Array:
        """Maps two arrays [B, H, W, C] or [B, S] to M models' actions [M, B, A].

        These are in [-1, 1].
        """
        embed = Embedding(self.encoder, self.feature_dim)
        features = [embed(observation), embed(successor)]
        shared: Any = None  # flax accepts it, but its types say numbers only
        heads = nn.vmap(
            MLP,
            in_axes=shared,
            axis_size=self.num_models,
            variable_axes={"params": 0},
            split_rngs={"params": True},
        )(self.hidden_dim, self.action_dim)
        return jnp.tanh(heads(jnp.concatenate(features, axis=-1)))
