"""One step of a discriminator, whatever it looks at."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.learner.state import ModuleState, apply_gradients
from jaxil.maths import losses
from jaxil.maths.types import Metrics, Params

Logits = Callable[[Params, Any], Array]  # parameters and inputs to logits [B]


def update_discriminator(
    state: ModuleState,
    logits: Logits,
    expert: Any,
    agent: Any,
    key: Array,
    *,
    penalty_weight: float,
    optimiser: optax.GradientTransformation,
) -> tuple[ModuleState, Metrics]:
    """Takes one step towards telling expert (label 1) from agent (label 0).

        max_D  mean log D(e) + mean log(1 - D(a)) - penalty_weight * GP

    Args:
      state: the discriminator.
      logits: its function.
      expert: inputs of demonstrations, a pytree of float arrays [B, ...].
      agent: the same of the agent. No gradient flows into either.
      key: consumed.
      penalty_weight: weight of `losses.gradient_penalty`; 10 in the paper.
      optimiser: of the discriminator.

    Source: Cohen et al. 2021, eq. (7).
    """
    expert, agent = jax.lax.stop_gradient((expert, agent))

    def loss(params: Params) -> tuple[Array, Metrics]:
        together = jax.tree.map(lambda *x: jnp.concatenate(x), expert, agent)
        expert_logits, agent_logits = jnp.split(logits(params, together), 2)
        cross_entropy = losses.discriminator_loss(expert_logits, agent_logits)
        penalty = losses.gradient_penalty(
            lambda x: logits(params, x), expert, agent, key
        )
        metrics = {
            "discriminator/loss": cross_entropy,
            "discriminator/penalty": penalty,
            "discriminator/expert_logit": jnp.mean(expert_logits),
            "discriminator/agent_logit": jnp.mean(agent_logits),
        }
        return cross_entropy + penalty_weight * penalty, metrics

    gradients, metrics = jax.grad(loss, has_aux=True)(state.params)
    return apply_gradients(state, gradients, optimiser), metrics
