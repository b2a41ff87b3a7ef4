"""Encoder, actor and critic together: the networks of one agent."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxil.maths.types import Params
from jaxil.networks.actor import Actor
from jaxil.networks.critic import Critic
from jaxil.networks.encoder import PixelEncoder, StateEncoder


class AgentNetworks(NamedTuple):
    """The three modules; their parameters live in the learner's state."""

    encoder: PixelEncoder | StateEncoder
    actor: Actor
    critic: Critic


def make_agent_networks(
    *,
    action_dim: int,
    feature_dim: int,
    hidden_dim: int,
    observation: str,
    channels: tuple[int, ...],
    kernel_sizes: tuple[int, ...],
    strides: tuple[int, ...],
    contrast: float,
    mean: Any,
    compute_dtype: str = "float32",
    native: bool = False,
) -> AgentNetworks:
    """Returns the networks of DrQ-v2.

    Args:
      action_dim: A.
      feature_dim: D, output of both trunks.
      hidden_dim: width of the actor's and the critics' MLPs.
      observation: "pixels" or "state".
      channels: of the convolutions, as are the next two.
      kernel_sizes: see `PixelEncoder`.
      strides: see `PixelEncoder`.
      contrast: see `PixelEncoder`.
      mean: see `PixelEncoder`.
      compute_dtype: "float32" or "bfloat16", of the convolutions and of the product
        that follows them.
      native: see `PixelEncoder`.
    """
    dtype = jnp.dtype(compute_dtype)
    if observation == "state":
        encoder = StateEncoder(hidden_dim)
    else:
        encoder = PixelEncoder(
            channels,
            kernel_sizes,
            strides,
            contrast,
            mean,
            dtype,
            native,
        )
    return AgentNetworks(
        encoder=encoder,
        actor=Actor(action_dim, feature_dim, hidden_dim, dtype),
        critic=Critic(feature_dim, hidden_dim, dtype),
    )


def apply(module: Any, params: Params, *inputs: Any, method: Any = None) -> Array:
    """Returns what a module computes, as the one array that all of ours return."""
    return module.apply(params, *inputs, method=method)


def actor_features(
    networks: AgentNetworks,
    encoder_params: Params,
    actor_params: Params,
    observation: Array,
) -> Array:
    """Returns trunk features of the actor. [B, H, W, C] to [B, D]."""
    representation = apply(networks.encoder, encoder_params, observation)
    actor = networks.actor
    return apply(actor, actor_params, representation, method=actor.features)


def critic_features(
    networks: AgentNetworks,
    encoder_params: Params,
    critic_params: Params,
    observation: Array,
) -> Array:
    """Returns trunk features of the critic. [B, H, W, C] to [B, D]."""
    representation = apply(networks.encoder, encoder_params, observation)
    critic = networks.critic
    return apply(critic, critic_params, representation, method=critic.features)
