"""Entropic transport: closed forms, marginals, and plain solvers in float64."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from absl.testing import parameterized
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxil.maths import transport


def plan_of(cost, *, epsilon=0.1, num_iterations=200):
    masses = (transport.uniform_mass(jnp.asarray(n), n) for n in cost.shape)
    return transport.sinkhorn_plan(
        cost, *masses, epsilon=epsilon, num_iterations=num_iterations
    )


solve = jax.jit(plan_of, static_argnames=("epsilon", "num_iterations"))


def plain_sinkhorn(cost, epsilon, num_iterations):
    """Log-domain Sinkhorn in float64, columns first and rows last."""
    cost = np.asarray(cost, np.float64)
    rows, columns = cost.shape
    f, g = np.zeros((rows, 1)), np.zeros((1, columns))
    for _ in range(num_iterations):
        g = -epsilon * scipy.special.logsumexp(
            (f - cost) / epsilon, axis=0, keepdims=True
        )
        g = g - epsilon * np.log(columns)
        f = -epsilon * scipy.special.logsumexp(
            (g - cost) / epsilon, axis=1, keepdims=True
        )
        f = f - epsilon * np.log(rows)
    return np.exp((f + g - cost) / epsilon)


class CosineCostTest(chex.TestCase):
    def test_at_0_90_and_180_degrees(self):
        x = jnp.array([[2.0, 0.0], [0.0, 0.5]])
        y = jnp.array([[3.0, 0.0], [0.0, 1.0], [-7.0, 0.0]])
        cost = jax.jit(transport.cosine_cost)(x, y)
        expected = [[0.0, 1.0, 2.0], [1.0, 0.0, 1.0]]
        np.testing.assert_allclose(cost, expected, atol=1e-6)

    def test_a_zero_feature_costs_one(self):
        cost = transport.cosine_cost(jnp.zeros((1, 3)), jnp.ones((2, 3)))
        np.testing.assert_allclose(cost, [[1.0, 1.0]])

    def test_rejects_features_of_other_sizes(self):
        with pytest.raises(AssertionError):
            transport.cosine_cost(jnp.ones((2, 3)), jnp.ones((2, 4)))


@settings(derandomize=True, max_examples=30, deadline=None)
@given(
    hnp.arrays(np.float32, (3, 4), elements=st.floats(-100, 100, width=32)),
    st.floats(0.1, 100),
)
def test_cosine_cost_is_in_range_and_ignores_length(x, factor):
    x = jnp.asarray(x)
    cost = np.asarray(transport.cosine_cost(x, x))
    assert np.all(cost >= 0.0)
    assert np.all(cost <= 2.0)
    lengths = np.linalg.norm(np.asarray(x), axis=1)
    if np.all(lengths > 1e-3):
        np.testing.assert_allclose(np.diag(cost), 0.0, atol=1e-5)
        np.testing.assert_allclose(
            transport.cosine_cost(x * np.float32(factor), x), cost, atol=1e-5
        )


class SinkhornPlanTest(chex.TestCase):
    @parameterized.parameters(1.0, 0.1, 0.005)  # the last underflows as exp(-C / e)
    def test_closed_form_of_two_points(self, epsilon):
        # C = [[0, 1], [1, 0]] and k = exp(-1 / epsilon): scaling the kernel by hand
        # gives P = [[1, k], [k, 1]] / (2 (1 + k)), balanced by symmetry.
        cost = jnp.array([[0.0, 1.0], [1.0, 0.0]])
        k = np.exp(-1.0 / epsilon)
        expected = np.array([[1.0, k], [k, 1.0]]) / (2.0 * (1.0 + k))
        plan = solve(cost, epsilon=epsilon)
        np.testing.assert_allclose(plan, expected, atol=1e-6)

    @parameterized.parameters(1, 7, 100)
    def test_runs_exactly_the_iterations_asked_for(self, num_iterations):
        # Slow to converge, so that plans after different counts differ.
        cost = 2.0 * jax.random.uniform(jax.random.key(5), (6, 4))
        plan = solve(cost, epsilon=0.02, num_iterations=num_iterations)
        expected = plain_sinkhorn(cost, 0.02, num_iterations)
        np.testing.assert_allclose(plan, expected, atol=1e-5)
        one_more = plain_sinkhorn(cost, 0.02, num_iterations + 1)
        if num_iterations < 100:
            assert np.abs(expected - one_more).max() > 1e-4

    @parameterized.parameters((1, 1), (1, 5), (7, 1), (7, 5))
    def test_marginals_are_uniform(self, num_agent, num_expert):
        plan = solve(jax.random.uniform(jax.random.key(0), (num_agent, num_expert)))
        assert np.all(np.asarray(plan) >= 0.0)
        np.testing.assert_allclose(plan.sum(1), 1.0 / num_agent, atol=1e-6)
        np.testing.assert_allclose(plan.sum(0), 1.0 / num_expert, atol=1e-4)

    def test_small_epsilon_is_finite(self):
        cost = 2.0 * jax.random.uniform(jax.random.key(3), (50, 40))
        plan = solve(cost, epsilon=0.001, num_iterations=100)
        chex.assert_tree_all_finite(plan)
        np.testing.assert_allclose(plan.sum(1), 1.0 / 50.0, atol=1e-5)

    def test_rejects_a_batch_of_costs(self):
        with pytest.raises(AssertionError):
            transport.sinkhorn_plan(
                jnp.zeros((2, 3, 3)),
                jnp.full(3, 1 / 3),
                jnp.full(3, 1 / 3),
                epsilon=0.1,
                num_iterations=1,
            )


class TransportRewardsTest(chex.TestCase):
    def test_by_hand(self):
        rewards = jax.jit(transport.transport_rewards)(
            jnp.array([[1.0, 2.0], [0.0, 4.0]]), jnp.array([[0.5, 0.0], [0.25, 0.25]])
        )
        np.testing.assert_allclose(rewards, [-0.5, -1.0])

    def test_sum_to_minus_the_transport_cost(self):
        cost = jax.random.uniform(jax.random.key(0), (6, 4))
        plan = solve(cost)
        rewards = transport.transport_rewards(cost, plan)
        assert np.all(np.asarray(rewards) <= 0.0)
        np.testing.assert_allclose(rewards.sum(), -np.vdot(cost, plan), rtol=1e-6)


def _brute_force_transport_cost(x, y, epsilon):
    """Entropic transport cost by plain scaling in float64: <P, C> + eps KL(P | ab)."""
    x, y = (np.asarray(each, np.float64) for each in (x, y))
    unit = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in (x, y)]
    cost = 1.0 - unit[0] @ unit[1].T
    kernel = np.exp(-cost / epsilon) / cost.size  # of the masses' product too
    u = np.ones(len(x))
    for _ in range(5000):
        v = 1.0 / len(y) / (kernel.T @ u)
        u = 1.0 / len(x) / (kernel @ v)
    plan = u[:, None] * kernel * v
    return np.sum(plan * cost) + epsilon * np.sum(plan * np.log(plan * cost.size))


def test_sinkhorn_divergence_against_brute_force():
    rng, epsilon = np.random.default_rng(0), 0.2
    x, y = (jnp.asarray(rng.normal(size=(n, 4)), jnp.float32) for n in (7, 5))
    divergence = functools.partial(
        transport.sinkhorn_divergence, epsilon=epsilon, num_iterations=300
    )
    ours = jax.jit(divergence)(x, y)

    def cost(one, other):
        return _brute_force_transport_cost(one, other, epsilon)

    expected = cost(x, y) - (cost(x, x) + cost(y, y)) / 2
    np.testing.assert_allclose(ours, expected, rtol=1e-4)


def test_sinkhorn_divergence_of_equal_sets_is_zero_and_it_is_symmetric():
    rng = np.random.default_rng(1)
    # As near to each other as features of a random encoder: entropy blurs them.
    near = 1.0 + 0.1 * rng.normal(size=(2, 30, 8))
    x, y = jnp.asarray(near, jnp.float32)
    divergence = jax.jit(
        functools.partial(
            transport.sinkhorn_divergence, epsilon=0.01, num_iterations=100
        )
    )
    np.testing.assert_allclose(divergence(x, x), 0.0, atol=1e-6)
    np.testing.assert_allclose(divergence(x, x[::-1]), 0.0, atol=1e-6)
    np.testing.assert_allclose(divergence(x, y), divergence(y, x), rtol=1e-3)
    further = divergence(x, y + jnp.linspace(0.0, 1.0, 8)[None])
    assert 0.0 < divergence(x, y) < further
