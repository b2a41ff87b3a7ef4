"""TemporalOT: optimal transport that knows the order of an episode."""

import functools

import chex
import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.maths import transport
from jaxil.rewarders.matching import Matching
from jaxil.rewarders.targets import make_target_rewarder

METHOD = methods.Method(
    name="temporal_ot",
    label="TemporalOT",
    about="optimal transport within a temporal band",
    colour="#882255",
    rank=8,
    sections={
        "sinkhorn": {
            "context_length": methods.Field(
                3, "frames that a cost is averaged over; 3 in the paper", 1, 100
            ),
            "band_steps": methods.Field(
                10,
                "largest distance in time between matched moments, in agent steps; "
                "10 in the paper",
                0,
                10**6,
            ),
            # A blocked pair costs 1000: with a larger epsilon that would not block it,
            # with a smaller one float32 could not resolve costs beside it.
            "epsilon": methods.Field(
                0.01, "weight of the entropy, in units of cost; 0.01", 1e-3, 1.0
            ),
            "num_iterations": methods.SINKHORN["num_iterations"],
            "return_scale": methods.SINKHORN["return_scale"],
            **methods.TARGETS,
        }
    },
    metrics=("sinkhorn/scale",),
)

_BLOCKED_COST = 1e3  # far above any cosine cost; float32 still resolves costs beside it


def make_rewarder(
    agent: AgentSpec,
    *,
    context_length: int,
    band_steps: int,
    epsilon: float,
    num_iterations: int,
    target_update_steps: int,
    return_scale: float,
) -> Rewarder:
    """Returns the rewarder of TemporalOT.

        r_t = - scale * sum_n C_{t+1,n} P_{t+1,n}

    It is P-SIL with another cost C, `context_cost`, and another plan P, `band_plan`.
    For the other arguments see `make_target_rewarder`.

    Source: Fu et al. 2024, Robot Policy Learning with Temporal Optimal Transport
    Reward, on the features of P-SIL; the paper's are those of a frozen ResNet.
    """

    def cost(
        agent: Array, expert: Array, agent_moments: Array, expert_moments: Array
    ) -> Array:
        return context_cost(
            transport.cosine_cost(agent, expert),
            agent_moments,
            expert_moments,
            context_length=context_length,
        )

    plan = functools.partial(
        band_plan,
        band_steps=band_steps,
        epsilon=epsilon,
        num_iterations=num_iterations,
    )
    matching = Matching(cost, plan)
    return make_target_rewarder(
        agent,
        compare=matching.rewards,
        plan=matching.closest_plan,
        target_update_steps=target_update_steps,
        return_scale=return_scale,
    )


def context_cost(
    cost: Array, agent_moments: Array, expert_moments: Array, *, context_length: int
) -> Array:
    """Averages costs over the moments that follow.

        C_tn = mean over k < context_length of c_{t+k, n+k}

    At the ends the mean is over the pairs that exist.

    Args:
      cost: c, of pairs of single moments. Shape [T, N].
      agent_moments: how many of the agent's T are not padding. Shape [].
      expert_moments: how many of the expert's N are not padding. Shape [].
      context_length: pairs in a mean; 1 returns the costs themselves.

    Returns:
      Costs; 0 for padding. Shape [T, N].

    Source: Fu et al. 2024, the context-aware cost; fuyw/TemporalOT.
    """
    chex.assert_rank([cost, agent_moments, expert_moments], [2, 0, 0])
    agent_time, expert_time = (jnp.arange(size) for size in cost.shape)
    own = (agent_time < agent_moments)[:, None] & (expert_time < expert_moments)[None]

    def total(values: Array) -> Array:
        shifts = (
            jnp.pad(values[k:, k:], [(0, min(k, size)) for size in values.shape])
            for k in range(context_length)
        )
        return functools.reduce(jnp.add, shifts)

    num_pairs = total(own.astype(cost.dtype))
    return total(jnp.where(own, cost, 0.0)) / jnp.maximum(num_pairs, 1.0)


def band_plan(
    cost: Array,
    agent_mass: Array,
    expert_mass: Array,
    *,
    band_steps: int,
    epsilon: float,
    num_iterations: int,
) -> Array:
    """Returns the entropic plan that moves mass only between moments of similar time.

        P_tn = 0  where  |t - n| > band_steps

    Where episodes differ in length, moments of the longer one without a partner in the
    band are matched outside it.

    Args:
      cost: pairwise costs, of the size of cosine costs. Shape [T, N].
      agent_mass, expert_mass, num_iterations: see `transport.sinkhorn_plan`, which
        makes the plan.
      band_steps: half the band's width.
      epsilon: weight of the entropy, in units of cost; at most 1.

    Source: Fu et al. 2024, the temporal mask; fuyw/TemporalOT.
    """
    chex.assert_rank([cost, agent_mass, expert_mass], [2, 1, 1])
    agent_time, expert_time = (jnp.arange(size) for size in cost.shape)
    inside = jnp.abs(agent_time[:, None] - expert_time[None]) <= band_steps
    return transport.sinkhorn_plan(
        jnp.where(inside, cost, _BLOCKED_COST),
        agent_mass,
        expert_mass,
        epsilon=epsilon,
        num_iterations=num_iterations,
    )
