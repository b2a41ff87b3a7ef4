"""GAIfO with DAC's learner: a discriminator of transitions with a separate encoder."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.maths.types import Params
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import TransitionDiscriminator
from jaxil.rewarders.discrimination import (
    Pair,
    TransitionJudge,
    make_transition_rewarder,
    twice_differentiable,
    unscaled,
)

METHOD = methods.Method(
    name="gaifo",
    label="GAIfO/DACfO",
    about="adversarial rewards on transitions of pixels",
    colour="#44AA99",
    rank=12,
    sections={"discriminator": {**methods.DISCRIMINATOR, "relabels": methods.RELABELS}},
    metrics=methods.DISCRIMINATOR_METRICS,
    variations=(methods.Variation("discriminator.relabels", True, "stored rewards"),),
)


def make_rewarder(agent: AgentSpec, *, hidden_dim: int, **training: Any) -> Rewarder:
    """Returns the rewarder of GAIfO, extended to pixels as DAC is.

        r_t = logit D(o_t, o_{t+1})

    It differs from DAC in that D sees the next observation instead of the action, and
    is trained on augmented pixels unless `shift_padding` is 0. The gradient penalty is
    on both observations.

    Args:
      agent: the discriminator's encoder has the architecture of its encoder.
      hidden_dim: width of the discriminator.
      **training: see `make_transition_rewarder`.

    Source: Torabi et al. 2018, Generative Adversarial Imitation from Observation,
    arXiv:1807.06158; off policy as in Kostrikov et al. 2019, arXiv:1809.02925;
    augmented as in PatchAIL's baseline with an independent encoder.
    """
    encoder = agent.networks.encoder
    discriminator = TransitionDiscriminator(encoder, agent.feature_dim, hidden_dim)
    smooth = discriminator.clone(encoder=twice_differentiable(encoder))

    def init(key: Array, spec: Spec) -> Params:
        observation = jnp.zeros((1, *spec.observation_shape))
        return discriminator.init(key, observation, observation)

    def logits(params: Params, pair: Pair) -> Array:
        return apply(discriminator, params, *pair)

    def penalised(params: Params, pair: Pair) -> Array:
        return apply(smooth, params, *map(unscaled, pair))

    judge = TransitionJudge(init, logits, penalised)
    return make_transition_rewarder(agent, judge, **training)
