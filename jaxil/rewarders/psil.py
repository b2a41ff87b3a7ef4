"""P-SIL: rewards from optimal transport to the closest demonstration."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from jaxil.learner.rewarder import Rewarder, Spec, keep_state
from jaxil.learner.state import LearnerParams, copy_params
from jaxil.maths import augmentation
from jaxil.maths.types import Episode, ExpertEpisodes, Params
from jaxil.networks.agent import AgentNetworks, actor_features
from jaxil.rewarders.matching import Matching


class SinkhornState(struct.PyTreeNode):
    """What P-SIL remembers between episodes.

    Attributes:
      target_encoder: copy of the live encoder.
      target_actor: copy of the live actor, of which the trunk is used.
      expert_features: demonstrations under the copies. Shape [K, N + 1, D].
      scale: factor on rewards, set by the first episode; 0 before. Shape [].
      steps_since_copy: agent steps in episodes since the last copy. Shape [].
    """

    target_encoder: Params
    target_actor: Params
    expert_features: Array
    scale: Array
    steps_since_copy: Array


def make_sinkhorn_rewarder(
    networks: AgentNetworks,
    *,
    matching: Matching,
    target_update_steps: int,
    return_scale: float,
    frame_stack: int,
) -> Rewarder:
    """Returns the rewarder of P-SIL.

        r_t = - scale * sum_n C_tn P_tn,    C = cosine distance, P = Sinkhorn plan

    between features of target copies of the actor's trunk on the encoder, to the
    demonstration that is cheapest to reach. The first episode is scaled to return
    `-return_scale`; that scale stays for good.

    The copies are taken at the end of the first episode that finds at least
    `target_update_steps` agent steps gone by since the last time, and at the first
    episode of all, when the live networks are still as initialised.

    Args:
      networks: of the agent; only the encoder and the actor's trunk are used.
      matching: cost and plan; see `make_matching`.
      target_update_steps: agent steps between copies; 10000 in the paper.
      return_scale: 10 in the paper.
      frame_stack: frames in an observation.

    Source: Cohen et al. 2021, sec. 3.1, eqs. (1) to (5); epsilon, iterations and
    the copied trunk, which the paper leaves out, from siddhanthaldar/ROT.
    """

    def embed(encoder: Params, actor: Params, frames: Array) -> Array:
        observations = augmentation.stack_frames(frames, frame_stack=frame_stack)
        return actor_features(networks, encoder, actor, observations)

    def init(key: Array, spec: Spec, learner: LearnerParams) -> SinkhornState:
        del key
        shape = (spec.num_demonstrations, spec.expert_steps + 1, spec.feature_dim)
        return SinkhornState(
            target_encoder=copy_params(learner.encoder),
            target_actor=copy_params(learner.actor),
            expert_features=jnp.zeros(shape),
            scale=jnp.zeros(()),
            # As if the last copy were long ago, so that the first episode copies.
            steps_since_copy=jnp.asarray(target_update_steps, jnp.int32),
        )

    def copy_targets(
        state: SinkhornState, learner: LearnerParams, expert_episodes: ExpertEpisodes
    ) -> SinkhornState:
        # One demonstration at a time: all at once would need gigabytes.
        expert_features = jax.lax.map(
            lambda frames: embed(learner.encoder, learner.actor, frames),
            expert_episodes.frames,
        )
        return SinkhornState(
            target_encoder=learner.encoder,
            target_actor=learner.actor,
            expert_features=expert_features,
            scale=state.scale,
            steps_since_copy=jnp.zeros((), jnp.int32),
        )

    def rewards(
        state: SinkhornState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes | None,
    ) -> tuple[Array, SinkhornState]:
        assert expert_episodes is not None
        num_steps = jnp.asarray(episode.actions.shape[0], jnp.int32)
        state = state.replace(steps_since_copy=state.steps_since_copy + num_steps)
        state = jax.lax.cond(
            state.steps_since_copy >= target_update_steps,
            lambda old: copy_targets(old, learner, expert_episodes),
            lambda old: old,
            state,
        )
        features = embed(state.target_encoder, state.target_actor, episode.frames)
        rewards, scale = matching.scaled_rewards(
            features,
            state.expert_features,
            expert_episodes.num_frames,
            scale=state.scale,
            return_scale=return_scale,
        )
        return rewards, state.replace(scale=scale)

    def plan(
        state: SinkhornState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes,
    ) -> Array:
        del learner
        features = embed(state.target_encoder, state.target_actor, episode.frames)
        return matching.closest_plan(
            features, state.expert_features, expert_episodes.num_frames
        )

    return Rewarder(
        init,
        keep_state,
        rewards,
        samples_expert=False,
        matches_episodes=True,
        summary=lambda state: {"sinkhorn/scale": state.scale},
        rewards_changed=lambda state: state.steps_since_copy == 0,
        plan=plan,
    )
