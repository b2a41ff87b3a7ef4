"""From one observation to one action."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.maths import distributions
from jaxil.maths.types import Data, Params
from jaxil.networks.agent import AgentNetworks, apply

Explore = Callable[[Params, Params, Data, Array, Data], Array]
ExploreTogether = Callable[[Params, Params, Data, Array, Data], Array]
Exploit = Callable[[Params, Params, Data], Array]


def make_explore(networks: AgentNetworks, exploration_std: optax.Schedule) -> Explore:
    """Returns the policy that gathers experience.

    (encoder params, actor params, observation [H, W, C], key, num_steps) -> action
    [A], where `num_steps` counts agent steps: it sets the noise's size and, with the
    run's base key, its draw. The noise is not clipped here: that is for updates.

    Args:
      networks: the agent's.
      exploration_std: standard deviation by agent step.
    """
    exploit = make_exploit(networks)

    def explore(
        encoder: Params, actor: Params, observation: Data, key: Array, num_steps: Data
    ) -> Array:
        mean = exploit(encoder, actor, observation)
        std = jnp.asarray(exploration_std(num_steps), mean.dtype)
        step_key = jax.random.fold_in(key, num_steps)
        return distributions.sample_truncated_normal(
            mean, std, step_key, noise_clip=None
        )

    return explore


def make_explore_together(
    networks: AgentNetworks, exploration_std: optax.Schedule
) -> ExploreTogether:
    """Returns the policy that gathers experience in several environments at once.

    (encoder params, actor params, observations [E, H, W, C], key, num_steps [E]) ->
    actions [E, A]: those of `make_explore`, each with the noise of its own agent step.

    Args:
      networks: the agent's.
      exploration_std: standard deviation by agent step.
    """
    explore = make_explore(networks, exploration_std)
    return jax.vmap(explore, in_axes=(None, None, 0, None, 0))


def make_exploit(networks: AgentNetworks) -> Exploit:
    """Returns the policy that is evaluated: the mean action, no noise.

    (encoder params, actor params, observation [H, W, C]) -> action [A].

    Args:
      networks: the agent's.
    """

    def exploit(encoder: Params, actor: Params, observation: Data) -> Array:
        representation = apply(networks.encoder, encoder, observation[None])
        return jnp.tanh(apply(networks.actor, actor, representation))[0]

    return exploit
