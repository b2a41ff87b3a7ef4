"""Which moments are paired: by hand, by SciPy, and in episodes of different lengths."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import distance

from jaxil.maths import transport
from jaxil.rewarders.matching import closest, make_matching


def matching(cost="euclidean", alignment="time"):
    return make_matching(
        cost=cost, alignment=alignment, epsilon=0.01, num_iterations=200
    )


def random(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def test_euclidean_cost_is_scipys():
    x, y = random(0, 7, 5), random(1, 4, 5)
    expected = distance.cdist(x, y)
    np.testing.assert_allclose(transport.euclidean_cost(x, y), expected, rtol=1e-4)


def test_at_the_same_time_by_hand():
    # Features are numbers; distances at the same moment: 1, 2, 4, then the expert's
    # last moment, 3, stands for all that follow.
    agent = jnp.array([[0.0], [0.0], [-1.0], [5.0], [3.0]])
    expert = jnp.array([[[1.0], [2.0], [3.0], [77.0]]])
    rewards = matching().rewards(agent, jnp.array(5), expert, jnp.array([3]))
    np.testing.assert_allclose(rewards, -np.array([1, 2, 4, 2, 0]) / 5, atol=1e-4)


def test_only_transport_forgives_another_order():
    expert = random(0, 1, 6, 4)
    backwards = expert[0, ::-1]
    compared = (backwards, jnp.array(6), expert, jnp.array([6]))
    aligned = matching("cosine", "transport").rewards(*compared)
    at_once = matching("cosine", "time").rewards(*compared)
    assert float(jnp.sum(aligned)) > -0.01
    assert float(jnp.sum(at_once)) < -0.3


@pytest.mark.parametrize("alignment", ["time", "transport"])
def test_the_closest_demonstration_counts(alignment):
    near, far = random(0, 6, 4), 5.0 + random(1, 6, 4)
    compared = (near, jnp.array(6), jnp.stack([far, near]), jnp.array([6, 6]))
    chosen = matching("euclidean", alignment)
    rewards = chosen.rewards(*compared)
    assert float(jnp.sum(rewards)) > -0.02
    plan, closest = chosen.closest_plan(*compared)
    assert int(closest) == 1
    np.testing.assert_allclose(plan, np.eye(6) / 6, atol=1e-3)


@pytest.mark.parametrize("alignment", ["time", "transport"])
def test_rows_carry_their_share_and_padding_carries_nothing(alignment):
    agent, experts = random(0, 7, 3), random(1, 2, 7, 3)
    compared = (agent, jnp.array(5), experts, jnp.array([4, 4]))
    plan, index = matching("cosine", alignment).closest_plan(*compared)
    shares = [0.2] * 5 + [0.0] * 2
    np.testing.assert_allclose(jnp.sum(plan, axis=1), shares, rtol=1e-5)
    assert float(jnp.max(plan[:, 4:])) < 1e-6
    alone = matching("cosine", alignment).closest_plan(
        agent[:5], jnp.array(5), experts[:, :4], jnp.array([4, 4])
    )
    assert int(index) == int(alone[1])
    np.testing.assert_allclose(plan[:5, :4], alone[0], rtol=1e-4, atol=1e-7)


def test_closest_is_by_cost_not_by_number():
    costs = jnp.array([[[3.0]], [[1.0]], [[2.0]]])
    np.testing.assert_allclose(closest(costs, jnp.ones((3, 1, 1)))[0], [-1.0])
