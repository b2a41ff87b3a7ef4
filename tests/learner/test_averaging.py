"""The average of policies: by hand, as a mean, in the limit, and beside any step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.learner.averaging import (
    average_policy,
    begin_average,
    make_averaging_step,
)
from jaxil.learner.state import PolicyParams
from jaxil.learner.update import make_update_step
from tests.learner.small_learner import make_batch, make_learner, make_state

AVERAGE = jax.jit(average_policy, static_argnames="tau")


def policy(value) -> PolicyParams:
    return PolicyParams({"kernel": jnp.asarray([value, -value])}, jnp.asarray(value))


def averages(values, tau, first=1e3):
    """Returns a_1 ... a_N of policies that are one number each."""
    average, found = policy(first), []
    for number, value in enumerate(values, start=1):
        average = AVERAGE(average, policy(value), jnp.int32(number), tau=tau)
        np.testing.assert_array_equal(average.encoder["kernel"][0], average.actor)
        found.append(float(average.actor))
    return found


def assert_same(one, other) -> None:
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), one, other
    )


def test_by_hand():
    # Means of 8 and 4, then shares of a half: (6 + 10) / 2 and (8 + 0) / 2.
    assert averages([8.0, 4.0, 10.0, 0.0], tau=0.5) == [8.0, 6.0, 8.0, 4.0]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-100, 100, width=32), min_size=1, max_size=20))
def test_it_is_the_mean_until_one_by_tau(values):
    last = averages(values, tau=0.05)[-1]
    np.testing.assert_allclose(last, np.mean(values), atol=1e-3)


def test_what_came_first_is_forgotten():
    # After the mean of 10 ones, 100 zeros leave 0.9^100 of it.
    last = averages([1.0] * 10 + [0.0] * 100, tau=0.1)[-1]
    np.testing.assert_allclose(last, 0.9**100, rtol=1e-3)


@pytest.mark.parametrize("tau", [0.25, 1.0])
def test_training_is_the_same_with_it(tau):
    learner = make_learner()
    plain = make_update_step(learner)
    averaging = jax.jit(make_averaging_step(plain, tau=tau))
    plain = jax.jit(plain)
    alone = make_state(learner)
    expected = alone.newest_policy
    state = begin_average(alone)
    assert_same(state.policy, expected)
    for number in range(1, 7):
        state, metrics = averaging(state, make_batch(number), None)
        alone, plain_metrics = plain(alone, make_batch(number), None)
        expected = AVERAGE(expected, alone.newest_policy, jnp.int32(number), tau=tau)
    assert_same((state.params, metrics), (alone.params, plain_metrics))
    assert_same(state.policy, expected)
    assert_same(alone.policy, alone.newest_policy)
