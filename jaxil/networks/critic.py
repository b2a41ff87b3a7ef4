"""Twin Q-functions on one trunk."""

from typing import Any

import chex
import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.networks.layers import MLP, Trunk


class Critic(nn.Module):
    """Two Q-functions of an action and the features of a shared trunk.

    Source: facebookresearch/drqv2, drqv2.py, `Critic`.
    """

    feature_dim: int
    hidden_dim: int
    dtype: Any = jnp.float32

    def setup(self) -> None:
        self.trunk = Trunk(self.feature_dim, self.dtype)
        self.value_1 = MLP(self.hidden_dim, 1)
        self.value_2 = MLP(self.hidden_dim, 1)

    def __call__(self, representation: Array, action: Array) -> Array:
        """Maps [B, R] and [B, A] to both values, [2, B]."""
        return self.values(self.features(representation), action)

    def features(self, representation: Array) -> Array:
        """Maps [B, R] to the trunk's features, [B, D], which P-DAC discriminates."""
        return self.trunk(representation)

    def values(self, features: Array, action: Array) -> Array:
        """Maps [B, D] and [B, A] to both values, [2, B]."""
        chex.assert_rank([features, action], 2)
        x = jnp.concatenate([features, action], axis=-1)
        return jnp.stack([self.value_1(x)[:, 0], self.value_2(x)[:, 0]])
