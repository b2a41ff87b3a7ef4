"""SIL on pixels, a baseline: transport in an adversarially trained embedding."""

from typing import Any

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
    copy_params,
    init_module,
)
from jaxil.maths import transport
from jaxil.maths.types import AnyEpisode, ExpertBatch, ExpertEpisodes, Metrics, Params
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import Embedding
from jaxil.rewarders.comparison import embed_demonstrations, make_comparing_rewarder
from jaxil.rewarders.matching import Matching, make_matching

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
      compared: its parameters as of the last episode's end, under which episodes are
        compared.
      expert_features: demonstrations under these. Shape [K, N + 1, D].
      scale: factor on rewards, set by the first episode; 0 before. Shape [].
    """

    embedding: ModuleState
    compared: Params
    expert_features: Array
    scale: Array


def make_rewarder(
    agent: AgentSpec,
    *,
    alignment: str,
    return_scale: float,
    learning_rate: float,
    batch_size: int,
    **of_matching: Any,
) -> Rewarder:
    """Returns the rewarder of SIL, extended to pixels.

        max_f  <C_f, P_f>,    r_t = - scale * sum_n C_{t+1,n} P_{t+1,n}

    The embedding f, with a separate encoder, is trained to maximise the Sinkhorn
    distance between a batch of the agent's observations and one of the expert's.
    Rewards are as in P-SIL, but under f as it is at each episode's end. Pixels are not
    augmented.

    Args:
      agent: the embedding's encoder has the architecture of its encoder.
      alignment: of the rewards; f always learns from transport.
      return_scale, learning_rate, batch_size: see the fields above.
      **of_matching: see `make_matching`.

    Source: Papagiannis and Li 2020, arXiv:2008.09167, sec. 3, on pixels as in Cohen
    et al. 2021, sec. 4.1. The original differs in more than pixels: it embeds whole
    episodes, on policy, into 10 linear outputs, at a learning rate of 5e-4. Here the
    learner is off policy, and each update trains f for one step on batches.
    """
    matching = make_matching(alignment=alignment, **of_matching)
    # A batch has no order in time.
    unordered = make_matching(alignment="transport", **of_matching)
    embedding = Embedding(agent.networks.encoder, agent.feature_dim)
    optimiser = optax.adam(learning_rate)

    def embed(state: SilState, frames: Array) -> Array:
        observations = agent.stack_frames(frames)
        return apply(embedding, state.compared, observations)

    def init(key: Array, spec: Spec, *_: Any) -> SilState:
        params = embedding.init(key, jnp.zeros((1, *spec.observation_shape)))
        shape = (spec.num_demonstrations, spec.expert_steps + 1, agent.feature_dim)
        return SilState(
            embedding=init_module(params, optimiser),
            compared=copy_params(params),
            expert_features=jnp.zeros(shape),
            scale=jnp.zeros(()),
        )

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
            return -batch_distance(unordered, mine, experts)

        value, gradients = jax.value_and_grad(loss)(state.embedding.params)
        state = state.replace(
            embedding=apply_gradients(state.embedding, gradients, optimiser)
        )
        return state, {"sinkhorn/distance": -value}

    def update_features(
        state: SilState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes,
    ) -> SilState:
        del learner, episode
        state = state.replace(compared=copy_params(state.embedding.params))
        return embed_demonstrations(embed, state, expert_episodes)

    rewarder = make_comparing_rewarder(
        init=init,
        update_features=update_features,
        embed=embed,
        compare=matching.rewards,
        plan=matching.closest_plan,
        return_scale=return_scale,
        rewards_changed=lambda state: True,
    )
    return rewarder._replace(update=update, expert_batch_size=batch_size)


def batch_distance(matching: Matching, agent: Array, expert: Array) -> Array:
    """Returns the transport cost between features of two batches, [B, D], to maximise.

        <C, P>   with the gradient   sum_tn P_tn dC_tn

    The plan has no gradient: by Danskin's theorem the one above is that of the entropic
    distance at the optimal plan, so Sinkhorn's iterations are not differentiated.
    """
    chex.assert_rank([agent, expert], 2)
    sizes = [jnp.asarray(len(batch)) for batch in (agent, expert)]
    cost = matching.cost(agent, expert, *sizes)
    masses = map(transport.uniform_mass, sizes, cost.shape)
    plan = matching.plan(jax.lax.stop_gradient(cost), *masses)
    return jnp.sum(cost * jax.lax.stop_gradient(plan))
