"""Rewarders that compare episodes under target copies of encoder and actor's trunk."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.state import LearnerParams, copy_params
from jaxil.maths import stacking
from jaxil.maths.types import AnyEpisode, ExpertEpisodes, Params
from jaxil.networks.agent import actor_features
from jaxil.rewarders.comparison import Compare, make_comparing_rewarder


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
    plan: Compare | None,
    target_update_steps: int,
    return_scale: float | None,
) -> Rewarder:
    """Returns a rewarder of whole episodes under slowly changing features.

    The copies are taken at the end of a run's first episode, when the live networks are
    still as initialised, and then at the end of each episode that completes at least
    `target_update_steps` agent steps since the last copy.

    Args:
      agent: its encoder, actor's trunk and frame stack are used.
      compare: see `make_comparing_rewarder`, as `plan` and `return_scale`.
      plan: the transport plan behind the rewards; None without one.
      target_update_steps: agent steps between copies.
      return_scale: minus the first episode's return; None: rewards are not scaled.
    """

    def embed(encoder: Params, actor: Params, frames: Array) -> Array:
        observations = stacking.stack_frames(frames, frame_stack=agent.frame_stack)
        return actor_features(agent.networks, encoder, actor, observations)

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
        # One demonstration at a time: all at once would need gigabytes.
        expert_features = jax.lax.map(
            lambda frames: embed(learner.encoder, learner.actor, frames),
            expert_episodes.frames,
        )
        return TargetState(
            target_encoder=learner.encoder,
            target_actor=learner.actor,
            expert_features=expert_features,
            scale=state.scale,
            steps_since_copy=jnp.zeros((), jnp.int32),
        )

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
        embed=lambda state, frames: embed(
            state.target_encoder, state.target_actor, frames
        ),
        compare=compare,
        plan=plan,
        return_scale=return_scale,
        rewards_changed=lambda state: state.steps_since_copy == 0,
    )
