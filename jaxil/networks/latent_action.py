"""Latent actions, inferred from videos whose actions are unknown."""

from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from jaxil.maths import quantisation
from jaxil.networks.layers import MLP, dense

_DECODER_WIDTHS = (192, 128, 64)  # liuxin0824/BCV-LR, run_online.py, `idm_decoder`
_CODE_RANGE = 5.0  # initial codes: uniform in +- this / num_codes, as in models.py


class LatentActionModel(nn.Module):
    """Infers latent actions from the features of two consecutive observations.

    `infer` is the inverse model, `predict` the forward model, and `decode` maps a
    latent action to the agent's. The published inverse and forward models are
    convolutional, on an encoder's feature maps; these are MLPs, on a trunk's features.

    Attributes:
      num_parts: P.
      num_codes: M, of each part.
      part_dim: L, numbers in a part.
      hidden_dim: width of the inverse and the forward model.
      feature_dim: D.
      action_dim: A.

    Source: Liu et al. 2025, arXiv:2512.21586; liuxin0824/BCV-LR, models.py, `IDM`,
    `VQEmbeddingEMA` and `WorldModel`, and utils.py, `create_decoder`.
    """

    num_parts: int
    num_codes: int
    part_dim: int
    hidden_dim: int
    feature_dim: int
    action_dim: int

    def setup(self) -> None:
        self.inverse = MLP(self.hidden_dim, self.num_parts * self.part_dim)
        self.forward = MLP(self.hidden_dim, self.feature_dim)
        self.decoder = _Decoder(self.action_dim)
        shape = (self.num_parts, self.num_codes, self.part_dim)
        self.codebook = self.param("codebook", _first_codes, shape)

    def __call__(self, features: Array, successor: Array) -> tuple[Array, Array]:
        """Runs `infer`, `predict` and `decode`, so that `init` makes all weights."""
        latent = self.infer(features, successor)
        code = self.codes(self.nearest(latent))
        return self.predict(features, code), self.decode(latent)

    def infer(self, features: Array, successor: Array) -> Array:
        """Maps two arrays of features [B, D] to latent actions [B, P, L]."""
        chex.assert_rank([features, successor], 2)
        chex.assert_equal_shape([features, successor])
        latent = self.inverse(jnp.concatenate([features, successor], axis=-1))
        return latent.reshape(-1, self.num_parts, self.part_dim)

    def nearest(self, latent: Array) -> Array:
        """Maps latent actions [B, P, L] to the indices of their codes, [B, P]."""
        return quantisation.nearest_codes(latent, self.codebook)

    def codes(self, indices: Array) -> Array:
        """Maps indices [B, P] to codes [B, P, L]."""
        return quantisation.look_up(indices, self.codebook)

    def predict(self, features: Array, code: Array) -> Array:
        """Maps features [B, D] and codes [B, P, L] to the next features [B, D]."""
        chex.assert_rank([features, code], [2, 3])
        flat = code.reshape(len(code), -1)
        return self.forward(jnp.concatenate([features, flat], axis=-1))

    def decode(self, latent: Array) -> Array:
        """Maps latent actions [B, P, L] to actions [B, A], in [-1, 1].

        The published decoder has no tanh; this one does because the actor's mean has.
        """
        chex.assert_rank(latent, 3)
        return jnp.tanh(self.decoder(latent.reshape(len(latent), -1)))


class _Decoder(nn.Module):
    action_dim: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps [B, P * L] to [B, A]."""
        for width in _DECODER_WIDTHS:
            x = nn.relu(dense(width)(x))
        return dense(self.action_dim)(x)


def _first_codes(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
    bound = _CODE_RANGE / shape[1]
    return jax.random.uniform(key, shape, dtype, minval=-bound, maxval=bound)
