"""Entropic optimal transport between two episodes as sets of features."""

import chex
import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.special import logsumexp, xlogy

_NORM_FLOOR = 1e-8  # keeps the cosine finite for an all-zero feature


def cosine_cost(x: Array, y: Array) -> Array:
    """Returns pairwise cosine distances.

        C_ij = 1 - <x_i, y_j> / (|x_i| |y_j|)   of x [T, D] and y [N, D], in [0, 2]

    Source: Cohen et al. 2021, eq. (2).
    """
    chex.assert_rank([x, y], 2)
    chex.assert_equal_shape_suffix([x, y], 1)
    x_unit = x / jnp.maximum(jnp.linalg.norm(x, axis=1, keepdims=True), _NORM_FLOOR)
    y_unit = y / jnp.maximum(jnp.linalg.norm(y, axis=1, keepdims=True), _NORM_FLOOR)
    # By default accelerators round factors to 11 bits, too coarse for epsilon = 0.01.
    cosine = jnp.matmul(x_unit, y_unit.T, precision=lax.Precision.HIGHEST)
    # Rounding may leave [-1, 1], and a negative cost would be a positive reward.
    return jnp.clip(1.0 - cosine, 0.0, 2.0)


def euclidean_cost(x: Array, y: Array) -> Array:
    """Returns pairwise Euclidean distances.

        C_ij = |x_i - y_j|   of x [T, D] and y [N, D]

    Source: Cohen et al. 2021, fig. 7.
    """
    chex.assert_rank([x, y], 2)
    chex.assert_equal_shape_suffix([x, y], 1)
    product = jnp.matmul(x, y.T, precision=lax.Precision.HIGHEST)
    squares = jnp.sum(x**2, 1)[:, None] + jnp.sum(y**2, 1)[None] - 2.0 * product
    # Rounding may make squares negative. The floor, a distance of 1e-4, also keeps the
    # root's gradient finite where two features are equal.
    return jnp.sqrt(jnp.maximum(squares, _NORM_FLOOR))


def simultaneous_plan(cost: Array, agent_mass: Array, expert_mass: Array) -> Array:
    """Returns the plan [T, N] that pairs step t with step t, without transport.

        P_tn = a_t  for  n = min(t, number of expert moments - 1),  else 0

    Only the shape of `cost` is used. Masses are 0 beyond an episode's own steps.

    Source: Cohen et al. 2021, fig. 7.
    """
    chex.assert_rank([cost, agent_mass, expert_mass], [2, 1, 1])
    chex.assert_shape(cost, (*agent_mass.shape, *expert_mass.shape))
    agent_length, expert_length = cost.shape
    last = jnp.sum(expert_mass > 0.0) - 1
    partners = jnp.minimum(jnp.arange(agent_length), last)
    pairs = jax.nn.one_hot(partners, expert_length, dtype=cost.dtype)
    return agent_mass[:, None] * pairs


def sinkhorn_plan(
    cost: Array,
    agent_mass: Array,
    expert_mass: Array,
    *,
    epsilon: float,
    num_iterations: int,
) -> Array:
    """Returns the entropic transport plan.

        P = argmin <P, C> - epsilon * H(P)   with   P 1 = a,  P^T 1 = b

    Computed in the log domain, since exp(-C / epsilon) underflows in float32 at the
    epsilon that imitation needs. The last iteration normalises the rows, so each step
    of the agent has its mass and rewards are not distorted. A fixed number of
    iterations keeps a vmap over demonstrations parallel.

    Args:
      cost: pairwise costs. Shape [T, N].
      agent_mass: a, see `uniform_mass`; sums to one. Shape [T].
      expert_mass: b, likewise. Shape [N].
      epsilon: weight of the entropy, in units of cost.
      num_iterations: Sinkhorn iterations; static under jit.

    Returns:
      Non-negative plan that sums to one. Rows are exact up to the rounding of
      C / epsilon, whose errors grow with it; columns are as accurate as the iterations
      have converged. Shape [T, N].

    Source: Peyre and Cuturi 2019, Computational Optimal Transport, sec. 4.4.
    """
    chex.assert_rank([cost, agent_mass, expert_mass], [2, 1, 1])
    chex.assert_shape(cost, (*agent_mass.shape, *expert_mass.shape))
    scaled = cost / epsilon
    log_agent, log_expert = jnp.log(agent_mass), jnp.log(expert_mass)

    def iterate(_, potentials):
        rows, _ = potentials
        columns = log_expert - logsumexp(rows[:, None] - scaled, axis=0)
        rows = log_agent - logsumexp(columns[None] - scaled, axis=1)
        return rows, columns

    # Rows without mass must not count in the first iteration either.
    start = jnp.where(agent_mass > 0.0, 0.0, -jnp.inf), jnp.zeros_like(expert_mass)
    rows, columns = lax.fori_loop(0, num_iterations, iterate, start)
    return jnp.exp(rows[:, None] + columns[None] - scaled)


def sinkhorn_divergence(
    x: Array, y: Array, *, epsilon: float, num_iterations: int
) -> Array:
    """Returns the debiased Sinkhorn divergence of two sets of points [., D].

        S(x, y) = OT(x, y) - (OT(x, x) + OT(y, y)) / 2,   with cosine costs C and
        OT(x, y) = min_P <P, C> + epsilon * KL(P | a b^T),   P 1 = a,  P^T 1 = b

    Entropy blurs the plan, so OT(x, x) > 0. S is symmetric, zero between a set and
    itself and, for these costs, never negative.

    See `sinkhorn_plan` for the arguments.

    Source: Feydy et al. 2019, Interpolating between Optimal Transport and MMD using
    Sinkhorn Divergences, eq. (1), (3) and theorem 1.
    """

    def transport_cost(x: Array, y: Array) -> Array:
        cost = cosine_cost(x, y)
        masses = (uniform_mass(jnp.asarray(len(each)), len(each)) for each in (x, y))
        plan = sinkhorn_plan(
            cost, *masses, epsilon=epsilon, num_iterations=num_iterations
        )
        kl_to_product = jnp.sum(xlogy(plan, plan * cost.size))  # a_i b_j = 1 / size
        return jnp.sum(plan * cost) + epsilon * kl_to_product

    own = transport_cost(x, x) + transport_cost(y, y)
    return transport_cost(x, y) - own / 2.0


def uniform_mass(num_moments: Array, length: int) -> Array:
    """Returns masses [length], equal for an episode's own steps and 0 for padding.

    b_n = 1 / num_moments for n < num_moments, else 0
    """
    chex.assert_rank(num_moments, 0)
    own = jnp.arange(length) < num_moments
    return jnp.where(own, 1.0 / num_moments, 0.0)


def transport_rewards(cost: Array, plan: Array) -> Array:
    """Returns what each step of the agent contributes to the transport cost.

        r_t = - sum_n C_tn P_tn,   so that   sum_t r_t = - <C, P>

    Cost and plan have shape [T, N]; rewards have shape [T] and are never positive.

    Source: Cohen et al. 2021, eq. (4).
    """
    chex.assert_rank([cost, plan], 2)
    chex.assert_equal_shape([cost, plan])
    return -jnp.sum(cost * plan, axis=1)
