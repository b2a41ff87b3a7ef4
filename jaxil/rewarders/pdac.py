"""P-DAC: rewards from a discriminator on the critic's own features."""

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, AgentView, Rewarder, Spec
from jaxil.learner.state import LearnerParams, ModuleState, init_module
from jaxil.maths import augmentation, stacking
from jaxil.maths.types import Episode, ExpertBatch, ExpertEpisodes, Metrics, Params
from jaxil.networks.agent import apply, critic_features
from jaxil.networks.discriminator import Discriminator
from jaxil.rewarders.discrimination import update_discriminator

METHOD = methods.Method(
    name="pdac",
    label="P-DAC",
    about="adversarial rewards on the critic's features",
    colour="#0072B2",
    rank=1,
    sections={
        "discriminator": {
            **methods.DISCRIMINATOR,
            "sees_actions": methods.Field(False, "appends actions to the features"),
        }
    },
    sees_actions="discriminator.sees_actions",
    metrics=methods.DISCRIMINATOR_METRICS,
    variations=(methods.Variation("discriminator.sees_actions", False, "actions"),),
)


def make_rewarder(
    agent: AgentSpec,
    *,
    hidden_dim: int,
    learning_rate: float,
    gradient_penalty: float,
    batch_size: int,
    sees_actions: bool,
) -> Rewarder:
    """Returns the rewarder of P-DAC.

        r = logit D(e)

    where D, see `update_discriminator`, judges critic-trunk features e of augmented
    observations, without gradient into encoder or trunk. log D - log(1 - D), the
    paper's reward, is the logit itself, and only the logit stays finite in float32.

    Args:
      agent: only its encoder and the critic's trunk are used.
      hidden_dim: width of the discriminator.
      learning_rate: of its Adam.
      gradient_penalty: its weight.
      batch_size: expert samples, and agent samples, in an update.
      sees_actions: whether actions are appended to the features: D(o_t, a_t).

    Source: Cohen et al. 2021, sec. 3.2; sizes and rates, which the paper leaves
    out, from siddhanthaldar/ROT.
    """
    discriminator = Discriminator(hidden_dim)
    optimiser = optax.adam(learning_rate)

    def inputs(features: Array, action: Array) -> Array:
        if not sees_actions:
            return features
        return jnp.concatenate([features, action], axis=-1)

    def logits(params: Params, x: Array) -> Array:
        return apply(discriminator, params, x)

    def init(key: Array, spec: Spec, learner: LearnerParams) -> ModuleState:
        del learner
        width = spec.feature_dim + (spec.action_dim if sees_actions else 0)
        params = discriminator.init(key, jnp.zeros((1, width)))
        return init_module(params, optimiser)

    def update(
        state: ModuleState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[ModuleState, Metrics]:
        assert expert is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        shift_key, penalty_key = jax.random.split(key)
        observation = augmentation.augment(
            expert.observation, shift_key, padding=agent.shift_padding
        )
        features = critic_features(
            agent.networks, learner.encoder, learner.critic, observation
        )
        return update_discriminator(
            state,
            logits,
            inputs(features, expert.action),
            inputs(view.features[:batch_size], view.action[:batch_size]),
            penalty_key,
            penalty_weight=gradient_penalty,
            optimiser=optimiser,
        )

    def rewards(
        state: ModuleState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes | None,
    ) -> Array:
        del expert_episodes
        observations = stacking.stack_frames(
            episode.frames, frame_stack=agent.frame_stack
        )
        # r(o_{t+1}), as in the reference; with actions the pair is (o_t, a_t).
        judged = observations[:-1] if sees_actions else observations[1:]
        features = critic_features(
            agent.networks, learner.encoder, learner.critic, judged
        )
        return logits(state.params, inputs(features, episode.actions))

    return Rewarder(
        rewards,
        init,
        update,
        expert_batch_size=batch_size,
        rewards_changed=lambda state: True,
    )
