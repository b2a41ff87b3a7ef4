"""The networks of an agent: encoder, actor and critic."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxil.maths.types import Params
from jaxil.networks.actor import Actor
from jaxil.networks.critic import Critic
from jaxil.networks.encoder import PixelEncoder, StateEncoder


class AgentNetworks(NamedTuple):
    """The three modules; their parameters are in the learner's state."""

    encoder: PixelEncoder | StateEncoder
    actor: Actor
    critic: Critic


def make_agent_networks(
    *,
    action_dim: int,
    feature_dim: int,
    hidden_dim: int,
    observation: str,
    compute_dtype: str = "float32",
    **of_pixels: Any,
) -> AgentNetworks:
    """Returns the networks of DrQ-v2.

    `observation` is "pixels" or "state". `compute_dtype` is "float32" or "bfloat16",
    for the convolutions and the product after them; `of_pixels` are fields of
    `PixelEncoder`.
    """
    dtype = jnp.dtype(compute_dtype)
    if observation == "state":
        encoder = StateEncoder(hidden_dim)
    else:
        encoder = PixelEncoder(dtype=dtype, **of_pixels)
    return AgentNetworks(
        encoder=encoder,
        actor=Actor(action_dim, feature_dim, hidden_dim, dtype),
        critic=Critic(feature_dim, hidden_dim, dtype),
    )


def apply(module: Any, params: Params, *inputs: Any, method: Any = None) -> Array:
    """Applies a module that returns one array."""
    return module.apply(params, *inputs, method=method)


def actor_features(
    networks: AgentNetworks,
    encoder_params: Params,
    actor_params: Params,
    observation: Array,
) -> Array:
    """Returns the features of the actor's trunk: [B, H, W, C] or [B, S] to [B, D]."""
    representation = apply(networks.encoder, encoder_params, observation)
    actor = networks.actor
    return apply(actor, actor_params, representation, method=actor.features)


def critic_features(
    networks: AgentNetworks,
    encoder_params: Params,
    critic_params: Params,
    observation: Array,
) -> Array:
    """Returns the features of the critic's trunk: [B, H, W, C] or [B, S] to [B, D]."""
    representation = apply(networks.encoder, encoder_params, observation)
    critic = networks.critic
    return apply(critic, critic_params, representation, method=critic.features)
