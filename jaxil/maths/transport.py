"""Entropic optimal transport between two episodes, seen as point clouds."""

import chex
import jax
import jax.numpy as jnp
from jax import Array, lax

_NORM_FLOOR = 1e-8  # keeps the cosine finite for an all-zero feature


def cosine_cost(x: Array, y: Array) -> Array:
    """Returns pairwise cosine distances.

        C_ij = 1 - <x_i, y_j> / (|x_i| |y_j|)

    Args:
      x: agent features. Shape [T, D].
      y: expert features. Shape [N, D].

    Returns:
      Costs in [0, 2]. Shape [T, N].

    Source: Cohen et al. 2021, eq. (2).
    """
    chex.assert_rank([x, y], 2)
    chex.assert_equal_shape_suffix([x, y], 1)
    x_unit = x / jnp.maximum(jnp.linalg.norm(x, axis=1, keepdims=True), _NORM_FLOOR)
    y_unit = y / jnp.maximum(jnp.linalg.norm(y, axis=1, keepdims=True), _NORM_FLOOR)
    # Accelerators round the factors of a product to 11 bits unless told otherwise,
    # an error that an epsilon of 0.01 would see.
    cosine = jnp.matmul(x_unit, y_unit.T, precision=lax.Precision.HIGHEST)
    # Rounding may leave [-1, 1], and a cost below zero would become a reward above.
    return jnp.clip(1.0 - cosine, 0.0, 2.0)


def euclidean_cost(x: Array, y: Array) -> Array:
    """Returns pairwise Euclidean distances.

        C_ij = |x_i - y_j|

    Args:
      x: agent features. Shape [T, D].
      y: expert features. Shape [N, D].

    Returns:
      Costs. Shape [T, N].

    Source: Cohen et al. 2021, fig. 7.
    """
    chex.assert_rank([x, y], 2)
    chex.assert_equal_shape_suffix([x, y], 1)
    product = jnp.matmul(x, y.T, precision=lax.Precision.HIGHEST)
    squares = jnp.sum(x**2, 1)[:, None] + jnp.sum(y**2, 1)[None] - 2.0 * product
    # The floor also keeps the root's gradient finite where two features are equal.
    return jnp.sqrt(jnp.maximum(squares, _NORM_FLOOR))


def simultaneous_plan(cost: Array, expert_mass: Array) -> Array:
    """Returns the plan that pairs moment t with moment t: no transport at all.

        P_tn = 1/T  for  n = min(t, number of the expert's moments - 1),  else 0

    Args:
      cost: read for its shape. Shape [T, N].
      expert_mass: zero beyond the expert's own moments. Shape [N].

    Returns:
      Shape [T, N].

    Source: Cohen et al. 2021, fig. 7.
    """
    chex.assert_rank([cost, expert_mass], [2, 1])
    chex.assert_equal_shape_suffix([cost, expert_mass], 1)
    num_steps, length = cost.shape
    last = jnp.sum(expert_mass > 0.0) - 1
    partners = jnp.minimum(jnp.arange(num_steps), last)
    return jax.nn.one_hot(partners, length, dtype=cost.dtype) / num_steps


def sinkhorn_plan(
    cost: Array, expert_mass: Array, *, epsilon: float, num_iterations: int
) -> Array:
    """Returns the entropic transport plan from uniform moments of the agent.

        P = argmin <P, C> - epsilon * H(P)   with   P 1 = 1/T,  P^T 1 = b

    In the log domain: exp(-C / epsilon) underflows in float32 at the epsilon that
    imitation needs. The iterations end on the rows, so each moment of the agent
    carries exactly its share and rewards are not distorted by row mass. A fixed
    count keeps a vmap over demonstrations parallel.

    Args:
      cost: pairwise costs. Shape [T, N].
      expert_mass: b, what each moment of the expert carries, see `uniform_mass`; sums
        to one. Shape [N].
      epsilon: weight of the entropy, in units of cost.
      num_iterations: Sinkhorn iterations; static under jit.

    Returns:
      Non-negative plan summing to one. Rows are exact, columns as far as the
      iterations have converged. Shape [T, N].

    Source: Peyre and Cuturi 2019, Computational Optimal Transport, sec. 4.4.
    """
    # Imported here because it takes seconds, which runs without transport save.
    from ott.geometry import geometry
    from ott.problems.linear import linear_problem
    from ott.solvers.linear import sinkhorn

    chex.assert_rank([cost, expert_mass], [2, 1])
    chex.assert_equal_shape_suffix([cost, expert_mass], 1)
    problem = linear_problem.LinearProblem(
        geometry.Geometry(cost_matrix=cost, epsilon=epsilon), b=expert_mass
    )
    solver = sinkhorn.Sinkhorn(
        lse_mode=True,
        min_iterations=num_iterations,
        max_iterations=num_iterations,
        # OTT runs whole blocks of this many and drops the remainder, without a word.
        inner_iterations=num_iterations,
        threshold=-1,
    )
    # Its measure of the marginals' error promotes ranks, which tests forbid.
    with jax.numpy_rank_promotion("allow"):
        return solver(problem).matrix


def sinkhorn_divergence(
    x: Array, y: Array, *, epsilon: float, num_iterations: int
) -> Array:
    """Returns the debiased Sinkhorn divergence of two sets of uniform points.

        S(x, y) = OT(x, y) - (OT(x, x) + OT(y, y)) / 2,   with cosine costs C and
        OT(x, y) = min_P <P, C> + epsilon * KL(P | a b^T),   P 1 = a,  P^T 1 = b

    OT alone is not zero between a set and itself: entropy blurs its plan. S is, is
    symmetric and, for these costs, nowhere below zero.

    Args:
      x: shape [T, D].
      y: shape [N, D].
      epsilon: weight of the entropy, in units of cost.
      num_iterations: Sinkhorn iterations; static under jit.

    Returns:
      Shape [].

    Source: Feydy et al. 2019, Interpolating between Optimal Transport and MMD using
    Sinkhorn Divergences, eq. (1), (3) and theorem 1.
    """

    def transport_cost(x: Array, y: Array) -> Array:
        cost = cosine_cost(x, y)
        mass = uniform_mass(jnp.asarray(len(y)), len(y))
        plan = sinkhorn_plan(cost, mass, epsilon=epsilon, num_iterations=num_iterations)
        # KL of a plan to the product of uniform masses.
        entropy = jnp.sum(jax.scipy.special.xlogy(plan, plan * cost.size))
        return jnp.sum(plan * cost) + epsilon * entropy

    own = transport_cost(x, x) + transport_cost(y, y)
    return transport_cost(x, y) - own / 2.0


def uniform_mass(num_moments: Array, length: int) -> Array:
    """Shares a mass of one out over an episode's own moments.

        b_n = 1 / num_moments for n < num_moments, else 0

    Args:
      num_moments: shape [].
      length: N, with what fills an episode up to the length of others.

    Returns:
      Masses. Shape [N].
    """
    chex.assert_rank(num_moments, 0)
    own = jnp.arange(length) < num_moments
    return jnp.where(own, 1.0 / num_moments, 0.0)


def transport_rewards(cost: Array, plan: Array) -> Array:
    """Shares a transport cost out over the agent's moments.

        r_t = - sum_n C_tn P_tn,   so that   sum_t r_t = - <C, P>

    Args:
      cost: shape [T, N].
      plan: shape [T, N].

    Returns:
      Rewards, never positive. Shape [T].

    Source: Cohen et al. 2021, eq. (4).
    """
    chex.assert_rank([cost, plan], 2)
    chex.assert_equal_shape([cost, plan])
    return -jnp.sum(cost * plan, axis=1)
