"""DAC on pixels, a baseline: rewards from a discriminator with eyes of its own."""

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.learner.rewarder import AgentView, Rewarder, Spec
from jaxil.learner.state import LearnerParams, ModuleState, init_module
from jaxil.maths import augmentation
from jaxil.maths.types import (
    Episode,
    ExpertBatch,
    ExpertEpisodes,
    Metrics,
    Params,
    Window,
)
from jaxil.networks.agent import AgentNetworks, apply
from jaxil.networks.discriminator import PixelDiscriminator
from jaxil.networks.encoder import PixelEncoder
from jaxil.rewarders.discrimination import update_discriminator

Inputs = tuple[Array, Array]  # pixels in [0, 1], float [B, H, W, C]; actions [B, A]


def make_dac_rewarder(
    networks: AgentNetworks,
    *,
    feature_dim: int,
    hidden_dim: int,
    learning_rate: float,
    penalty_weight: float,
    batch_size: int,
    frame_stack: int,
) -> Rewarder:
    """Returns the rewarder of DAC, extended to pixels.

        r_t = logit D(o_t, a_t)

    D has its own convolutions, sees pixels that are not augmented and the expert's
    actions, and rewards sampled transitions anew at each update: the three things
    that P-DAC does differently. Its gradient penalty is on pixels and actions.

    Args:
      networks: of the agent; the discriminator's encoder is made like its own.
      feature_dim: D, of the trunk that squeezes the pixels before the action joins.
      hidden_dim: width of the discriminator.
      learning_rate: of its Adam.
      penalty_weight: weight of the gradient penalty.
      batch_size: N, expert samples and agent samples in a step.
      frame_stack: frames in an observation.

    Source: Kostrikov et al. 2019, arXiv:1809.02925, on pixels as in Cohen et al. 2021,
    sec. 4.1.
    """
    encoder = networks.encoder
    if isinstance(encoder, PixelEncoder):  # the penalty differentiates it twice
        encoder = encoder.clone(native=False)
    discriminator = PixelDiscriminator(encoder, feature_dim, hidden_dim)
    optimiser = optax.adam(learning_rate)

    def inputs(observation: Array, action: Array) -> Inputs:
        observation = jnp.asarray(observation)
        if observation.ndim == 4:
            observation = observation.astype(jnp.float32) / 255.0
        return observation, action

    def logits(params: Params, x: Inputs) -> Array:
        observation, action = x
        if observation.ndim == 4:  # the encoder takes pixels as they are stored
            observation = 255.0 * observation
        return apply(discriminator, params, observation, action)

    def init(key: Array, spec: Spec, learner: LearnerParams) -> ModuleState:
        del learner
        observation = jnp.zeros((1, *spec.observation_shape))
        params = discriminator.init(key, observation, jnp.zeros((1, spec.action_dim)))
        return init_module(params, optimiser)

    def update(
        state: ModuleState,
        learner: LearnerParams,
        agent: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[ModuleState, Metrics]:
        del learner
        assert expert is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        return update_discriminator(
            state,
            logits,
            inputs(expert.observation, expert.action),
            inputs(agent.unshifted[:batch_size], agent.action[:batch_size]),
            key,
            penalty_weight=penalty_weight,
            optimiser=optimiser,
        )

    def relabel(state: ModuleState, learner: LearnerParams, window: Window) -> Array:
        del learner
        chex.assert_equal_shape_prefix([window.observation, window.action], 2)
        observation, action = jax.tree.map(
            lambda x: jnp.reshape(x, (-1, *x.shape[2:])),
            (window.observation, window.action),
        )
        flat = logits(state.params, inputs(observation, action))
        return flat.reshape(window.action.shape[:2])

    def rewards(
        state: ModuleState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes | None,
    ) -> tuple[Array, ModuleState]:
        # For people only: what the agent learns from is `relabel`.
        del learner, expert_episodes
        observations = augmentation.stack_frames(
            episode.frames, frame_stack=frame_stack
        )
        x = inputs(observations[:-1], jnp.asarray(episode.actions))
        return logits(state.params, x), state

    return Rewarder(
        init,
        update,
        rewards,
        samples_expert=True,
        matches_episodes=False,
        relabel=relabel,
    )
