"""Rewarders that compare episodes under a fixed code of the pixels."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import AnyEpisode, ExpertEpisodes
from jaxil.rewarders import codes
from jaxil.rewarders.comparison import Compare, make_comparing_rewarder


class CodedState(struct.PyTreeNode):
    """What such a rewarder remembers between episodes.

    Attributes:
      code: fitted to the demonstrations and the first episode, then fixed.
      expert_features: demonstrations in that code. Shape [K, N + 1, F * J].
      scale: factor on rewards, set by the first episode; 0 before. Shape [].
    """

    code: codes.FrameCode
    expert_features: Array
    scale: Array


def make_coded_rewarder(
    agent: AgentSpec,
    *,
    num_components: int,
    compare: Compare,
    plan: Compare,
    return_scale: float,
) -> Rewarder:
    """Returns a rewarder of whole episodes under principal components of the frames.

    Nothing that the agent learns changes the code, so stored rewards stay valid.

    Args:
      agent: only its frame stack is used.
      num_components: J, of each of the F frames of an observation.
      compare: see `make_comparing_rewarder`, as `plan` and `return_scale`.
      plan: the transport plan behind the rewards.
      return_scale: minus the first episode's return.
    """
    frame_stack = agent.frame_stack

    def init(key: Array, spec: Spec, learner: LearnerParams) -> CodedState:
        del key, learner
        width = num_components * frame_stack
        return CodedState(
            code=codes.init_code(
                spec.observation_shape,
                num_components=num_components,
                frame_stack=frame_stack,
            ),
            expert_features=jnp.zeros(
                (spec.num_demonstrations, spec.expert_steps + 1, width)
            ),
            scale=jnp.zeros(()),
        )

    def update_features(
        state: CodedState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes,
    ) -> CodedState:
        del learner

        def fit() -> CodedState:
            code = codes.fix(codes.fit(state.code, episode, expert_episodes))
            features = jax.lax.map(
                lambda frames: codes.encode_episode(
                    code, frames, frame_stack=frame_stack
                ),
                jnp.asarray(expert_episodes.frames),
            )
            return state.replace(code=code, expert_features=features)

        return jax.lax.cond(state.code.is_fixed, lambda: state, fit)

    return make_comparing_rewarder(
        init=init,
        update_features=update_features,
        embed=lambda state, frames: codes.encode_episode(
            state.code, frames, frame_stack=frame_stack
        ),
        compare=compare,
        plan=plan,
        return_scale=return_scale,
        rewards_changed=None,
    )
