"""SIL on pixels, a baseline: transport in an embedding that learns to tell apart."""

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from jaxil.learner.rewarder import AgentView, Rewarder, Spec
from jaxil.learner.state import (
    LearnerParams,
    ModuleState,
    apply_gradients,
    init_module,
)
from jaxil.maths import augmentation, transport
from jaxil.maths.types import Episode, ExpertBatch, ExpertEpisodes, Metrics, Params
from jaxil.networks.agent import AgentNetworks, apply
from jaxil.networks.discriminator import Embedding
from jaxil.rewarders.matching import Matching


class SilState(struct.PyTreeNode):
    """What SIL learns and remembers.

    Attributes:
      embedding: the adversary.
      scale: factor on rewards, set by the first episode; 0 before. Shape [].
    """

    embedding: ModuleState
    scale: Array


def make_sil_rewarder(
    networks: AgentNetworks,
    *,
    matching: Matching,
    feature_dim: int,
    learning_rate: float,
    batch_size: int,
    return_scale: float,
    frame_stack: int,
) -> Rewarder:
    """Returns the rewarder of SIL, extended to pixels.

        max_f  <C_f, P_f>,    r_t = - scale * sum_n C_tn P_tn

    The embedding f, with convolutions of its own, is trained to make the Sinkhorn
    distance between a batch of the agent's observations and one of the expert's as
    large as it can; an episode is rewarded by the live f, without a target copy, as
    in P-SIL otherwise. Pixels are not augmented.

    Args:
      networks: of the agent; the embedding's encoder is made like its own.
      matching: cost and plan.
      feature_dim: D.
      learning_rate: of the embedding's Adam.
      batch_size: N, expert and agent samples in a step.
      return_scale: the first episode returns minus this.
      frame_stack: frames in an observation.

    Source: Papagiannis and Li 2020, arXiv:2008.09167, sec. 3, on pixels as in Cohen
    et al. 2021, sec. 4.1. They embed whole episodes; batches, as discriminators have,
    give the off-policy learner one step of f for each of its own.
    """
    embedding = Embedding(networks.encoder, feature_dim)
    optimiser = optax.adam(learning_rate)

    def embed(params: Params, frames: Array) -> Array:
        observations = augmentation.stack_frames(frames, frame_stack=frame_stack)
        return apply(embedding, params, observations)

    def init(key: Array, spec: Spec, learner: LearnerParams) -> SilState:
        del learner
        params = embedding.init(key, jnp.zeros((1, *spec.observation_shape)))
        return SilState(init_module(params, optimiser), jnp.zeros(()))

    def update(
        state: SilState,
        learner: LearnerParams,
        agent: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[SilState, Metrics]:
        del learner, key
        assert expert is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        both = jnp.concatenate([agent.unshifted[:batch_size], expert.observation])

        def loss(params: Params) -> Array:
            mine, experts = jnp.split(apply(embedding, params, both), 2)
            return -batch_distance(matching, mine, experts)

        value, gradients = jax.value_and_grad(loss)(state.embedding.params)
        state = state.replace(
            embedding=apply_gradients(state.embedding, gradients, optimiser)
        )
        return state, {"sinkhorn/distance": -value}

    def features(
        state: SilState, episode: Episode, expert_episodes: ExpertEpisodes
    ) -> tuple[Array, Array]:
        params = state.embedding.params
        # One demonstration at a time: all at once would need gigabytes.
        experts = jax.lax.map(lambda f: embed(params, f), expert_episodes.frames)
        return embed(params, episode.frames), experts

    def rewards(
        state: SilState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes | None,
    ) -> tuple[Array, SilState]:
        del learner
        assert expert_episodes is not None
        mine, experts = features(state, episode, expert_episodes)
        rewards, scale = matching.scaled_rewards(
            mine,
            experts,
            expert_episodes.num_frames,
            scale=state.scale,
            return_scale=return_scale,
        )
        return rewards, state.replace(scale=scale)

    def plan(
        state: SilState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes,
    ) -> Array:
        del learner
        mine, experts = features(state, episode, expert_episodes)
        return matching.closest_plan(mine, experts, expert_episodes.num_frames)

    return Rewarder(
        init,
        update,
        rewards,
        samples_expert=True,
        matches_episodes=True,
        summary=lambda state: {"sinkhorn/scale": state.scale},
        rewards_changed=lambda state: True,
        plan=plan,
    )


def batch_distance(matching: Matching, agent: Array, expert: Array) -> Array:
    """Returns the transport cost between two batches of features, to be ascended.

        <C, P>   with the gradient   sum_tn P_tn dC_tn

    At its optimum the plan answers to first order for nothing (Danskin's theorem), so
    no gradient passes through Sinkhorn's iterations.

    Args:
      matching: cost and plan.
      agent: shape [B, D].
      expert: shape [B, D].
    """
    chex.assert_rank([agent, expert], 2)
    cost = matching.cost(agent, expert)
    whole = jnp.asarray(expert.shape[0])
    mass = transport.uniform_mass(whole, expert.shape[0])
    plan = matching.plan(jax.lax.stop_gradient(cost), mass)
    return jnp.sum(cost * jax.lax.stop_gradient(plan))
