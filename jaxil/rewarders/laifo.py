"""LAIfO: rewards from a discriminator of transitions between the critic's features."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder, RewarderState, Spec
from jaxil.maths.types import Params
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import Discriminator
from jaxil.rewarders.discrimination import (
    Pair,
    TransitionJudge,
    make_transition_rewarder,
)

METHOD = methods.Method(
    name="laifo",
    label="LAIfO",
    about="adversarial rewards on transitions of the critic's features",
    colour="#332288",
    rank=11,
    sections={
        "discriminator": {
            **methods.DISCRIMINATOR,
            "learning_rate": methods.Field(
                4e-4, "of its Adam; 4e-4 in the paper", 0, 1, positive=True
            ),
            "reward": methods.Field(
                "decision",
                "decision: 1 where it takes the agent for the expert, else 0, as in "
                "the authors' code; logit: as in P-DAC",
                choices=("decision", "logit"),
            ),
            "relabels": methods.RELABELS,
        }
    },
    metrics=methods.DISCRIMINATOR_METRICS,
    variations=(
        methods.Variation("discriminator.reward", "decision", "{}"),
        methods.Variation("discriminator.relabels", True, "stored rewards"),
    ),
)


def make_rewarder(
    agent: AgentSpec, *, hidden_dim: int, reward: str, **training: Any
) -> Rewarder:
    """Returns the rewarder of LAIfO.

        r_t = 1 if logit D(z_t, z_{t+1}) > 0 else 0

    where z are the critic trunk's features, without gradient into encoder or trunk.

    Args:
      agent: only its encoder and the critic's trunk are used.
      hidden_dim: width of the discriminator.
      reward: "decision", the equation above, or "logit", the logit itself.
      **training: see `make_transition_rewarder`.

    Source: Giammarino et al. 2024, Adversarial Imitation Learning from Visual
    Observations using Latent Information, arXiv:2309.17371, and its code,
    VittorioGiammarino/AIL_from_visual_obs. There, actor and critic share one trunk, an
    n-step return judges one transition over all n steps, the penalty is on the decision
    and rewards are of augmented observations; here each single step is judged, the
    penalty is on the logit and rewards are of observations as they are.
    """
    discriminator = Discriminator(hidden_dim)

    def init(key: Array, spec: Spec) -> Params:
        return discriminator.init(key, jnp.zeros((1, 2 * agent.feature_dim)))

    def logits(params: Params, pair: Pair) -> Array:
        return apply(discriminator, params, jnp.concatenate(pair, axis=-1))

    def rewarded(_: RewarderState, logits: Array) -> Array:
        return logits if reward == "logit" else (logits > 0.0).astype(logits.dtype)

    judge = TransitionJudge(
        init,
        logits,
        inputs=agent.critic_features,
        agent_inputs=lambda view: (view.features, view.successor_features),
        reward=rewarded,
    )
    return make_transition_rewarder(agent, judge, **training)
