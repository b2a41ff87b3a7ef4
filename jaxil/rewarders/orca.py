"""ORCA: rewards for having covered every moment of a demonstration, in order."""

import chex
import jax
import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.maths import transport
from jaxil.rewarders.targets import make_target_rewarder

METHOD = methods.Method(
    name="orca",
    label="ORCA",
    about="the probability of having covered a demonstration in its order",
    colour="#8c6d1f",
    rank=9,
    sections={
        "coverage": {
            "temperature": methods.Field(
                1.0, "of costs turned into probabilities; 1 in the paper", 1e-3, 1e3
            ),
            # The authors' demonstrations are short; a product over our 501 would be 0.
            "num_waypoints": methods.Field(
                20, "evenly spaced frames of a demonstration to be covered", 2, 10_000
            ),
            **methods.TARGETS,
        }
    },
)


def make_rewarder(
    agent: AgentSpec,
    *,
    temperature: float,
    num_waypoints: int,
    target_update_steps: int,
) -> Rewarder:
    """Returns the rewarder of ORCA.

        r_t = probability that o_0 ... o_{t+1} have covered the demonstration in its
              order and that o_{t+1} covers its end

    from cosine costs between features of P-SIL's target copies, see `coverage_rewards`.
    The demonstration with the largest return counts. Rewards are in [0, 1] and not
    scaled.

    Args:
      agent, target_update_steps: see `make_target_rewarder`.
      temperature: see `coverage_rewards`.
      num_waypoints: frames of a demonstration that have to be covered.

    Source: Huey et al. 2025, Imitation Learning from a Single Temporally Misaligned
    Video; portal-cornell/orca. The paper has one demonstration, and all its frames
    have to be covered.
    """

    def compare(
        agent: Array, agent_moments: Array, experts: Array, expert_moments: Array
    ) -> Array:
        own = jnp.arange(len(agent)) < agent_moments

        def rewards(expert: Array, num_moments: Array) -> Array:
            chosen = expert[waypoints(num_moments, num_waypoints)]
            cost = transport.cosine_cost(agent, chosen)
            covered = coverage_rewards(cost, temperature=temperature)
            return jnp.where(own, covered, 0.0)

        candidates = jax.vmap(rewards)(experts, expert_moments)
        return candidates[jnp.argmax(jnp.sum(candidates, axis=1))]

    return make_target_rewarder(
        agent, compare=compare, target_update_steps=target_update_steps
    )


def waypoints(num_moments: Array, num_waypoints: int) -> Array:
    """Returns indices of evenly spaced moments, the first and the last among them.

    Args:
      num_moments: the expert's moments, without padding. Shape [].
      num_waypoints: at least 2; if above `num_moments`, some are repeated.

    Returns:
      int32, ascending. Shape [num_waypoints].
    """
    chex.assert_rank(num_moments, 0)
    last = num_moments - 1
    return jnp.round(jnp.linspace(0.0, last, num_waypoints)).astype(jnp.int32)


def coverage_rewards(cost: Array, *, temperature: float) -> Array:
    """Returns how likely each moment completes the expert's moments in their order.

        p_tn = exp(-C_tn / temperature)
        cov_t0 = max(cov_{t-1,0}, p_t0)
        cov_tn = max(cov_{t-1,n}, cov_{t,n-1} p_tn)
        r_t = cov_{t,N-2} p_{t,N-1}

    with cov_{-1,n} = 0. The last moment has no max: an agent that leaves it earns less.

    Args:
      cost: C >= 0. Shape [T, N], with N >= 2.
      temperature: the larger, the less distance matters.

    Returns:
      Rewards in [0, 1]. Shape [T].

    Source: Huey et al. 2025, the ordered coverage reward; portal-cornell/orca.
    """
    chex.assert_rank(cost, 2)
    chex.assert_axis_dimension_gt(cost, 1, 1)
    # In logarithms: a product of many probabilities would underflow.
    log_p = -cost.T / temperature
    first = jax.lax.cummax(log_p[0])

    def cover(covered: Array, log_p_n: Array) -> tuple[Array, None]:
        return jax.lax.cummax(covered + log_p_n), None

    covered, _ = jax.lax.scan(cover, first, log_p[1:-1])
    return jnp.exp(covered + log_p[-1])
