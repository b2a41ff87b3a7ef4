"""SIL on pixels, a baseline: transport in an adversarially trained embedding."""

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, AgentView, Rewarder, Spec
from jaxil.learner.state import (
    LearnerParams,
    ModuleState,
    apply_gradients,
    init_module,
)
from jaxil.maths import stacking, transport
from jaxil.maths.types import AnyEpisode, ExpertBatch, ExpertEpisodes, Metrics, Params
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import Embedding
from jaxil.rewarders.matching import (
    Matching,
    make_matching,
    scale_of_first_episode,
)

METHOD = methods.Method(
    name="sil",
    label="SIL",
    about="optimal transport in an adversarially trained embedding",
    colour="#E69F00",
    rank=4,
    sections={
        "sinkhorn": methods.SINKHORN,
        "discriminator": {
            "learning_rate": methods.DISCRIMINATOR["learning_rate"],
            "batch_size": methods.DISCRIMINATOR["batch_size"],
        },
    },
    metrics=("sinkhorn/scale", "sinkhorn/distance"),
)


class SilState(struct.PyTreeNode):
    """What SIL learns and remembers.

    Attributes:
      embedding: the adversary.
      scale: factor on rewards, set by the first episode; 0 before. Shape [].
    """

    embedding: ModuleState
    scale: Array


def make_rewarder(
    agent: AgentSpec,
    *,
    cost: str,
    alignment: str,
    epsilon: float,
    num_iterations: int,
    return_scale: float,
    learning_rate: float,
    batch_size: int,
) -> Rewarder:
    """Returns the rewarder of SIL, extended to pixels.

        max_f  <C_f, P_f>,    r_t = - scale * sum_n C_{t+1,n} P_{t+1,n}

    The embedding f, with a separate encoder, is trained to maximise the Sinkhorn
    distance between a batch of the agent's observations and one of the expert's.
    Rewards are as in P-SIL, but under the live f, without a target copy. Pixels are
    not augmented.

    Args:
      agent: the embedding's encoder has the architecture of its encoder.
      cost, alignment, epsilon, num_iterations: see `make_matching`.
      return_scale: the first episode returns minus this.
      learning_rate: of the embedding's Adam.
      batch_size: expert samples, and agent samples, in an update.

    Source: Papagiannis and Li 2020, arXiv:2008.09167, sec. 3, on pixels as in Cohen
    et al. 2021, sec. 4.1. The original differs in more than pixels: it embeds whole
    episodes, on policy, into 10 linear outputs, at a learning rate of 5e-4. Here the
    learner is off policy, and each update trains f for one step on batches.
    """
    matching = make_matching(
        cost=cost, alignment=alignment, epsilon=epsilon, num_iterations=num_iterations
    )
    embedding = Embedding(agent.networks.encoder, agent.feature_dim)
    optimiser = optax.adam(learning_rate)

    def embed(params: Params, frames: Array) -> Array:
        observations = stacking.stack_frames(frames, frame_stack=agent.frame_stack)
        return apply(embedding, params, observations)

    def init(key: Array, spec: Spec, learner: LearnerParams) -> SilState:
        del learner
        params = embedding.init(key, jnp.zeros((1, *spec.observation_shape)))
        return SilState(init_module(params, optimiser), jnp.zeros(()))

    def update(
        state: SilState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[SilState, Metrics]:
        del learner, key
        assert expert is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        both = jnp.concatenate([view.unshifted[:batch_size], expert.observation])

        def loss(params: Params) -> Array:
            mine, experts = jnp.split(apply(embedding, params, both), 2)
            return -batch_distance(matching, mine, experts)

        value, gradients = jax.value_and_grad(loss)(state.embedding.params)
        state = state.replace(
            embedding=apply_gradients(state.embedding, gradients, optimiser)
        )
        return state, {"sinkhorn/distance": -value}

    def features_and_moments(
        state: SilState, episode: AnyEpisode, expert_episodes: ExpertEpisodes
    ) -> tuple[Array, Array, Array, Array]:
        params = state.embedding.params
        return (
            embed(params, jnp.asarray(episode.frames)),
            jnp.asarray(episode.num_steps) + 1,
            # One demonstration at a time: all at once would need gigabytes.
            jax.lax.map(lambda f: embed(params, f), expert_episodes.frames),
            jnp.asarray(expert_episodes.num_frames),
        )

    def unscaled(
        state: SilState, episode: AnyEpisode, expert_episodes: ExpertEpisodes | None
    ) -> Array:
        assert expert_episodes is not None
        compared = features_and_moments(state, episode, expert_episodes)
        return matching.rewards(*compared)[1:]  # reward t is that of o_{t+1}

    def observe(
        state: SilState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes | None,
    ) -> SilState:
        del learner
        scale = scale_of_first_episode(
            state.scale,
            lambda: unscaled(state, episode, expert_episodes),
            return_scale,
        )
        return state.replace(scale=scale)

    def rewards(
        state: SilState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes | None,
    ) -> Array:
        del learner
        return state.scale * unscaled(state, episode, expert_episodes)

    def plan(
        state: SilState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes,
    ) -> tuple[Array, Array]:
        del learner
        compared = features_and_moments(state, episode, expert_episodes)
        return matching.closest_plan(*compared)

    return Rewarder(
        rewards,
        init,
        update,
        observe,
        expert_batch_size=batch_size,
        matches_episodes=True,
        ignores_padding=True,
        summary=lambda state: {"sinkhorn/scale": state.scale},
        rewards_changed=lambda state: True,
        plan=plan,
    )


def batch_distance(matching: Matching, agent: Array, expert: Array) -> Array:
    """Returns the transport cost between two batches of features, to be maximised.

        <C, P>   with the gradient   sum_tn P_tn dC_tn

    The plan has no gradient: by Danskin's theorem the one above is that of the entropic
    distance at the optimal plan, so Sinkhorn's iterations are not differentiated.

    Args:
      matching: cost and plan.
      agent: shape [B, D].
      expert: shape [B, D].
    """
    chex.assert_rank([agent, expert], 2)
    cost = matching.cost(agent, expert)
    masses = (
        transport.uniform_mass(jnp.asarray(len(batch)), len(batch))
        for batch in (agent, expert)
    )
    plan = matching.plan(jax.lax.stop_gradient(cost), *masses)
    return jnp.sum(cost * jax.lax.stop_gradient(plan))
