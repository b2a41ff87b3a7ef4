"""Rewarders that compare episodes under target copies of encoder and actor's trunk."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.state import LearnerParams, copy_params
from jaxil.maths.types import AnyEpisode, ExpertEpisodes, Params
from jaxil.networks.agent import actor_features
from jaxil.rewarders.comparison import (
    Compare,
    embed_demonstrations,
    make_comparing_rewarder,
)


class TargetState(struct.PyTreeNode):
    """What such a rewarder remembers between episodes.

    Attributes:
      target_encoder: copy of the live encoder.
      target_actor: copy of the live actor, of which the trunk is used.
      expert_features: demonstrations under the copies. Shape [K, N + 1, D].
      scale: factor on rewards, set by the first episode; 0 before; always 1 where
        rewards are not scaled. Shape [].
      steps_since_copy: agent steps in episodes since the last copy. Shape [].
    """

    target_encoder: Params
    target_actor: Params
    expert_features: Array
    scale: Array
    steps_since_copy: Array


def make_target_rewarder(
    agent: AgentSpec,
    *,
    compare: Compare,
    target_update_steps: int,
    plan: Compare | None = None,
    return_scale: float | None = None,
) -> Rewarder:
    """Returns a rewarder of whole episodes under slowly changing features.

    The copies are taken at the end of a run's first episode, when the live networks are
    still as initialised, and then at the end of each episode that completes at least
    `target_update_steps` agent steps since the last copy.

    Args:
      agent: its encoder, actor's trunk and frame stack are used.
      compare, plan, return_scale: see `make_comparing_rewarder`.
      target_update_steps: agent steps between copies.
    """

    def embed(state: TargetState, frames: Array) -> Array:
        return actor_features(
            agent.networks,
            state.target_encoder,
            state.target_actor,
            agent.stack_frames(frames),
        )

    def init(key: Array, spec: Spec, learner: LearnerParams) -> TargetState:
        del key
        shape = (spec.num_demonstrations, spec.expert_steps + 1, agent.feature_dim)
        return TargetState(
            target_encoder=copy_params(learner.encoder),
            target_actor=copy_params(learner.actor),
            expert_features=jnp.zeros(shape),
            scale=jnp.ones(()) if return_scale is None else jnp.zeros(()),
            # As if the last copy were long ago, so that the first episode copies.
            steps_since_copy=jnp.asarray(target_update_steps, jnp.int32),
        )

    def copy_targets(
        state: TargetState, learner: LearnerParams, expert_episodes: ExpertEpisodes
    ) -> TargetState:
        state = state.replace(
            target_encoder=learner.encoder,
            target_actor=learner.actor,
            steps_since_copy=jnp.zeros((), jnp.int32),
        )
        return embed_demonstrations(embed, state, expert_episodes)

    def update_features(
        state: TargetState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes,
    ) -> TargetState:
        num_steps = jnp.asarray(episode.num_steps, jnp.int32)
        state = state.replace(steps_since_copy=state.steps_since_copy + num_steps)
        return jax.lax.cond(
            state.steps_since_copy >= target_update_steps,
            lambda old: copy_targets(old, learner, expert_episodes),
            lambda old: old,
            state,
        )

    return make_comparing_rewarder(
        init=init,
        update_features=update_features,
        embed=embed,
        compare=compare,
        plan=plan,
        return_scale=return_scale,
        rewards_changed=lambda state: state.steps_since_copy == 0,
    )
