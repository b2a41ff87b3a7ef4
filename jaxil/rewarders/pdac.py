"""P-DAC: rewards from a discriminator on the critic's features, or a code of pixels."""

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, AgentView, Rewarder, Spec
from jaxil.learner.state import LearnerParams, ModuleState
from jaxil.maths.types import AnyEpisode, ExpertBatch, ExpertEpisodes, Metrics
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import Discriminator
from jaxil.networks.encoder import PixelEncoder
from jaxil.rewarders import codes
from jaxil.rewarders.codes import FrameCode
from jaxil.rewarders.discrimination import update_discriminator

METHOD = methods.Method(
    name="pdac",
    label="P-DAC",
    about="adversarial rewards on single observations",
    colour="#0072B2",
    rank=1,
    sections={"discriminator": methods.PDAC_DISCRIMINATOR},
    sees_actions="discriminator.sees_actions",
    metrics=methods.DISCRIMINATOR_METRICS,
    variations=(methods.Variation("discriminator.sees_actions", False, "actions"),),
)


class JudgeState(ModuleState):
    """The discriminator, and the code of pixels if it judges that.

    Attributes:
      code: None where it judges the critic's features.
    """

    code: FrameCode | None


def make_rewarder(
    agent: AgentSpec,
    *,
    hidden_dim: int,
    learning_rate: float,
    gradient_penalty: float,
    batch_size: int,
    sees_actions: bool,
    num_components: int,
) -> Rewarder:
    """Returns the rewarder of P-DAC.

        r_t = logit D(x_{t+1})

    where x are the critic trunk's features, without gradient into encoder or trunk. D
    is trained on augmented observations, see `update_discriminator`. The paper's reward
    log D - log(1 - D) is the logit itself, and only the logit stays finite in float32.

    With `num_components`, x is `codes.encode` of observations without augmentation. It
    shows the whole image from the start and does not change, whereas the critic's
    features show what rewards have taught so far.

    Args:
      agent: its encoder, critic's trunk, frame stack and shift are used.
      hidden_dim, learning_rate, gradient_penalty, batch_size: see
        `methods.DISCRIMINATOR`.
      sees_actions: whether actions are appended to the features: D(x_t, a_t).
      num_components: of each frame; 0, the paper's: the critic's features, as always
        for state vectors, which have no code.

    Source: Cohen et al. 2021, sec. 3.2; sizes and rates, which the paper leaves
    out, from siddhanthaldar/ROT. The code of pixels is this project's own.
    """
    discriminator = Discriminator(hidden_dim)
    logits = functools.partial(apply, discriminator)
    optimiser = optax.adam(learning_rate)
    if not isinstance(agent.networks.encoder, PixelEncoder):
        num_components = 0
    encode = functools.partial(codes.encode, frame_stack=agent.frame_stack)

    def inputs(features: Array, action: Array) -> Array:
        if not sees_actions:
            return features
        return jnp.concatenate([features, action], axis=-1)

    def init(key: Array, spec: Spec, *_: Any) -> JudgeState:
        code, width = None, agent.feature_dim
        if num_components:
            code = codes.init_code(
                spec.observation_shape,
                num_components=num_components,
                frame_stack=agent.frame_stack,
            )
            width = num_components * agent.frame_stack
        width += spec.action_dim if sees_actions else 0
        params = discriminator.init(key, jnp.zeros((1, width)))
        return JudgeState(params, optimiser.init(params), code)

    def observe(
        state: JudgeState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes | None,
    ) -> JudgeState:
        del learner
        if state.code is None:
            return state
        assert expert_episodes is not None
        return state.replace(code=codes.observe(state.code, episode, expert_episodes))

    def update(
        state: JudgeState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[JudgeState, Metrics]:
        assert expert is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        shift_key, penalty_key = jax.random.split(key)
        code = state.code
        if code is None:
            observation = agent.augment(expert.observation, shift_key)
            expert_features = agent.critic_features(learner, observation)
            features = view.features[:batch_size]
        else:
            # Not augmented: a shift would change the code, which is all that D sees.
            expert_features = encode(code, jnp.asarray(expert.observation))
            features = encode(code, view.unshifted[:batch_size])
            code = codes.fix(code)
        state, metrics = update_discriminator(
            state,
            logits,
            inputs(expert_features, expert.action),
            inputs(features, view.action[:batch_size]),
            penalty_key,
            penalty_weight=gradient_penalty,
            optimiser=optimiser,
        )
        return state.replace(code=code), metrics

    def features_of(state: JudgeState, learner: LearnerParams, frames: Array) -> Array:
        if state.code is not None:
            return codes.encode_episode(
                state.code, frames, frame_stack=agent.frame_stack
            )
        return agent.critic_features(learner, agent.stack_frames(frames))

    def rewards(
        state: JudgeState, learner: LearnerParams, episode: AnyEpisode, *_: Any
    ) -> Array:
        features = features_of(state, learner, episode.frames)
        # r(o_{t+1}), as in the reference; with actions the pair is (o_t, a_t).
        judged = features[:-1] if sees_actions else features[1:]
        return logits(state.params, inputs(judged, episode.actions))

    return Rewarder(
        rewards,
        init,
        update,
        observe,
        expert_batch_size=batch_size,
        matches_episodes=bool(num_components),
        ignores_padding=True,
        rewards_changed=lambda state: True,
    )
