"""Tells the expert's features from the agent's."""

import flax.linen as nn
from jax import Array

from jaxil.networks.layers import MLP


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
