"""Policies: functions from observations to actions."""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.maths import distributions
from jaxil.maths.types import Data, Params
from jaxil.networks.agent import AgentNetworks, apply

SampleAction = Callable[[Params, Params, Data, Array, Data], Array]
MeanAction = Callable[[Params, Params, Data], Array]


def make_sample_action(
    networks: AgentNetworks, exploration_std: optax.Schedule
) -> SampleAction:
    """Returns the policy that collects experience.

    (encoder params, actor params, observations [E, H, W, C], key, num_steps [E]) ->
    actions [E, A], for E environments. The agent step `num_steps` sets the noise's
    standard deviation and, with the key, its draw. Only updates clip the noise.
    """
    mean_action = make_mean_action(networks)

    def sample_action(
        encoder: Params, actor: Params, observations: Data, key: Array, num_steps: Data
    ) -> Array:
        chex.assert_equal_shape_prefix([observations, num_steps], 1)

        def noisy(mean: Array, step: Array) -> Array:
            std = jnp.asarray(exploration_std(step), mean.dtype)
            step_key = jax.random.fold_in(key, step)
            return distributions.sample_truncated_normal(
                mean, std, step_key, noise_clip=None
            )

        means = mean_action(encoder, actor, observations)
        return jax.vmap(noisy)(means, jnp.asarray(num_steps))

    return sample_action


def make_mean_action(networks: AgentNetworks) -> MeanAction:
    """Returns the policy that is evaluated, without noise.

    (encoder params, actor params, observations [E, H, W, C]) -> actions [E, A].
    """

    def mean_action(encoder: Params, actor: Params, observations: Data) -> Array:
        representation = apply(networks.encoder, encoder, observations)
        return jnp.tanh(apply(networks.actor, actor, representation))

    return mean_action
