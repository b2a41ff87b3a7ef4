"""The policy network."""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxil.networks.layers import MLP, Trunk


class Actor(nn.Module):
    """Trunk and MLP that compute the mean action before its tanh.

    Source: facebookresearch/drqv2, drqv2.py, `Actor`.
    """

    action_dim: int
    feature_dim: int
    hidden_dim: int
    dtype: Any = jnp.float32

    def setup(self) -> None:
        self.trunk = Trunk(self.feature_dim, self.dtype)
        self.head = MLP(self.hidden_dim, self.action_dim)

    def __call__(self, representation: Array) -> Array:
        """Maps [B, R] to the mean before tanh, [B, A]."""
        return self.head(self.features(representation))

    def features(self, representation: Array) -> Array:
        """Maps [B, R] to the trunk's features, [B, D], which P-SIL compares."""
        return self.trunk(representation)
