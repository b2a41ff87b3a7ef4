"""P-SIL: rewards from optimal transport to the closest demonstration."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import AnyEpisode, ExpertEpisodes
from jaxil.networks.encoder import PixelEncoder
from jaxil.rewarders import codes
from jaxil.rewarders.comparison import embed_demonstrations, make_comparing_rewarder
from jaxil.rewarders.matching import Matching, make_matching
from jaxil.rewarders.targets import make_target_rewarder

METHOD = methods.Method(
    name="psil",
    label="P-SIL",
    about="optimal transport to the closest demonstration",
    colour="#D55E00",
    rank=2,
    sections={"sinkhorn": methods.PSIL_SINKHORN},
    metrics=("sinkhorn/scale",),
    variations=(
        methods.Variation("sinkhorn.cost", "cosine", "{}"),
        methods.Variation("sinkhorn.alignment", "transport", "not aligned"),
    ),
)


def make_rewarder(
    agent: AgentSpec,
    *,
    target_update_steps: int,
    return_scale: float,
    num_components: int,
    **of_matching: Any,
) -> Rewarder:
    """Returns the rewarder of P-SIL.

        r_t = - scale * sum_n C_{t+1,n} P_{t+1,n}

    with cosine distances C and the Sinkhorn plan P to the demonstration that is
    cheapest to reach. It compares features of target copies of the encoder and the
    actor's trunk or, with `num_components`, principal components of the pixels; state
    vectors have none, so their features are compared. See `make_matching`,
    `make_target_rewarder` and `make_component_rewarder` for the arguments.

    Source: Cohen et al. 2021, sec. 3.1, eqs. (1) to (5); epsilon, iterations and
    the copied trunk, which the paper leaves out, from siddhanthaldar/ROT.
    """
    matching = make_matching(**of_matching)
    if num_components and isinstance(agent.networks.encoder, PixelEncoder):
        return make_component_rewarder(
            agent, matching, num_components=num_components, return_scale=return_scale
        )
    return make_target_rewarder(
        agent,
        compare=matching.rewards,
        plan=matching.closest_plan,
        target_update_steps=target_update_steps,
        return_scale=return_scale,
    )


class CodedState(struct.PyTreeNode):
    """What the rewarder of principal components remembers between episodes.

    Attributes:
      code: fitted to the demonstrations and the first episode, then fixed.
      expert_features: demonstrations in that code. Shape [K, N + 1, F * J].
      scale: factor on rewards, set by the first episode; 0 before. Shape [].
    """

    code: codes.FrameCode
    expert_features: Array
    scale: Array


def make_component_rewarder(
    agent: AgentSpec, matching: Matching, *, num_components: int, return_scale: float
) -> Rewarder:
    """Returns a rewarder of whole episodes under principal components of the frames.

    Nothing that the agent learns changes the code, so stored rewards stay valid.

    Args:
      agent: only its frame stack is used.
      matching: compares episodes.
      num_components: J, of each of the F frames of an observation.
      return_scale: minus the first episode's return.
    """

    def embed(state: CodedState, frames: Array) -> Array:
        return codes.encode_episode(state.code, frames, frame_stack=agent.frame_stack)

    def init(key: Array, spec: Spec, *_: Any) -> CodedState:
        del key
        width = num_components * agent.frame_stack
        return CodedState(
            code=codes.init_code(
                spec.observation_shape,
                num_components=num_components,
                frame_stack=agent.frame_stack,
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
            return embed_demonstrations(
                embed, state.replace(code=code), expert_episodes
            )

        return jax.lax.cond(state.code.is_fixed, lambda: state, fit)

    return make_comparing_rewarder(
        init=init,
        update_features=update_features,
        embed=embed,
        compare=matching.rewards,
        plan=matching.closest_plan,
        return_scale=return_scale,
    )
