"""DAC on pixels, a baseline: a discriminator with a separate encoder, relabelling."""

from typing import Any

import chex
import jax.numpy as jnp
import optax
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, AgentView, Rewarder, Spec
from jaxil.learner.state import LearnerParams, ModuleState, init_module
from jaxil.maths.types import AnyEpisode, Batch, ExpertBatch, Metrics, Params
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import PixelDiscriminator
from jaxil.rewarders.discrimination import (
    twice_differentiable,
    unscaled,
    update_discriminator,
)

METHOD = methods.Method(
    name="dac",
    label="DAC",
    about="adversarial rewards on pixels and actions",
    colour="#56B4E9",
    rank=3,
    sections={"discriminator": methods.DISCRIMINATOR},
    sees_actions=True,
    metrics=methods.DISCRIMINATOR_METRICS,
)

Inputs = tuple[Array, Array]  # pixels [B, H, W, C], or states [B, S]; actions [B, A]


def make_rewarder(
    agent: AgentSpec,
    *,
    hidden_dim: int,
    learning_rate: float,
    gradient_penalty: float,
    batch_size: int,
) -> Rewarder:
    """Returns the rewarder of DAC, extended to pixels.

        r_t = logit D(o_t, a_t)

    It differs from P-DAC in three ways: D has a separate encoder, it sees the expert's
    actions and pixels that are not augmented, and rewards are recomputed for every
    batch. The gradient penalty is on pixels and actions.

    Args:
      agent: the discriminator's encoder has the architecture of its encoder.
      hidden_dim, learning_rate, gradient_penalty, batch_size: see
        `methods.DISCRIMINATOR`.

    Source: Kostrikov et al. 2019, arXiv:1809.02925, on pixels as in Cohen et al. 2021,
    sec. 4.1.
    """
    encoder = agent.networks.encoder
    discriminator = PixelDiscriminator(encoder, agent.feature_dim, hidden_dim)
    smooth = discriminator.clone(encoder=twice_differentiable(encoder))
    optimiser = optax.adam(learning_rate)

    def logits(params: Params, x: Inputs) -> Array:
        return apply(discriminator, params, *x)

    def penalised(params: Params, x: Inputs) -> Array:
        observation, action = x
        return apply(smooth, params, unscaled(observation), action)

    def init(key: Array, spec: Spec, *_: Any) -> ModuleState:
        observation = jnp.zeros((1, *spec.observation_shape))
        params = discriminator.init(key, observation, jnp.zeros((1, spec.action_dim)))
        return init_module(params, optimiser)

    def update(
        state: ModuleState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[ModuleState, Metrics]:
        del learner
        assert expert is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        return update_discriminator(
            state,
            logits,
            (expert.observation, expert.action),
            (view.unshifted[:batch_size], view.action[:batch_size]),
            key,
            penalty_weight=gradient_penalty,
            optimiser=optimiser,
            penalised=penalised,
        )

    def relabel(state: ModuleState, learner: LearnerParams, batch: Batch) -> Array:
        del learner
        window = batch.window
        assert window is not None
        chex.assert_equal_shape_prefix([window.observation, window.action], 2)
        observation, action = (
            jnp.reshape(x, (-1, *x.shape[2:]))
            for x in (window.observation, window.action)
        )
        flat = logits(state.params, (observation, action))
        return flat.reshape(window.action.shape[:2])

    def rewards(
        state: ModuleState, learner: LearnerParams, episode: AnyEpisode, *_: Any
    ) -> Array:
        # For the log only: the agent learns from `relabel`.
        del learner
        observations = agent.stack_frames(episode.frames)
        return logits(state.params, (observations[:-1], jnp.asarray(episode.actions)))

    return Rewarder(
        rewards,
        init,
        update,
        expert_batch_size=batch_size,
        ignores_padding=True,
        relabel=relabel,
    )
