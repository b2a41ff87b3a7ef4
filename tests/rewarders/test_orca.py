"""ORCA: its table by hand, and order, which alone it rewards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.rewarders import orca
from tests.tiny_agent import (
    make_agent,
    make_episode,
    make_experts,
    make_params,
    make_spec,
    random_frames,
)


def rewards_of(probabilities, temperature=1.0):
    cost = -temperature * np.log(np.asarray(probabilities, np.float32))
    return np.asarray(orca.coverage_rewards(jnp.asarray(cost), temperature=temperature))


def table_of(probabilities):
    """The dynamic program cell by cell; the last column has no max."""
    table = np.zeros(probabilities.shape)
    last = len(table[0]) - 1
    for t, n in np.ndindex(*table.shape):
        covered = probabilities[t, n] * (table[t, n - 1] if n else 1.0)
        before = table[t - 1, n] if t and n < last else 0.0
        table[t, n] = max(before, covered)
    return table


@pytest.mark.parametrize("temperature", [1.0, 0.25])
def test_a_table_by_hand(temperature):
    p = [[0.5, 0.4, 0.2], [0.8, 0.5, 0.5], [0.1, 0.9, 0.8]]
    # Columns: 0.5, 0.8, 0.8; then 0.5 * 0.4, 0.8 * 0.5, 0.8 * 0.9; then the last,
    # 0.2 * 0.2, 0.4 * 0.5, 0.72 * 0.8.
    expected = [0.04, 0.2, 0.576]
    np.testing.assert_allclose(rewards_of(p, temperature), expected, rtol=1e-5)


@pytest.mark.parametrize("shape", [(7, 2), (7, 5), (1, 4)])
def test_agrees_with_the_table_cell_by_cell(shape):
    p = np.random.default_rng(0).uniform(0.05, 1, shape)
    np.testing.assert_allclose(rewards_of(p), table_of(p)[:, -1], rtol=1e-4)


def test_coverage_is_kept_but_the_end_must_be_held():
    # With an end that every moment covers, rewards are the coverage of the rest.
    p = np.random.default_rng(1).uniform(0.05, 1, (30, 4))
    p[:, -1] = 1.0
    assert np.all(np.diff(rewards_of(p)) >= 0.0)
    p[20:, -1] = 0.1
    assert np.all(rewards_of(p)[20:] < rewards_of(p)[19])


def test_order_matters():
    near, far = 0.95, 0.1
    p = np.full((4, 4), far)
    np.fill_diagonal(p, near)
    assert rewards_of(p)[-1] == pytest.approx(near**4, rel=1e-4)
    assert rewards_of(p[::-1])[-1] < 0.15
    # Waiting costs nothing, leaving a moment out does.
    assert rewards_of(p[[0, 1, 1, 1, 2, 3]])[-1] == pytest.approx(near**4, rel=1e-4)
    assert rewards_of(p[[0, 1, 3]])[-1] < 0.15


def test_many_moments_do_not_underflow_on_the_way():
    assert rewards_of(np.full((2, 400), 0.8)).min() >= 0.0
    cost = jnp.full((3, 40), 2.0)
    rewards = orca.coverage_rewards(cost, temperature=1.0)
    np.testing.assert_allclose(rewards, np.exp(-80.0), rtol=1e-3)


@pytest.mark.parametrize("shape", [(3, 1), (3,)])
def test_refuses_costs_of_another_shape(shape):
    with pytest.raises(AssertionError):
        orca.coverage_rewards(jnp.zeros(shape), temperature=1.0)


@pytest.mark.parametrize(
    ("num_moments", "expected"),
    [(101, [0, 25, 50, 75, 100]), (5, [0, 1, 2, 3, 4]), (2, [0, 0, 0, 1, 1])],
)
def test_waypoints_are_spread_over_an_episodes_own_moments(num_moments, expected):
    chosen = orca.waypoints(jnp.array(num_moments), 5)
    assert chosen.dtype == jnp.int32
    assert chosen.tolist() == expected


def test_played_back_demonstrations_beat_backwards_ones_and_are_not_scaled():
    steps, params = 11, make_params(0)
    frames = random_frames(0, 2, steps + 1)
    # The first is short: what follows its fifth frame is padding.
    experts = make_experts(frames)._replace(num_frames=np.array([5, steps + 1]))
    rewarder = orca.make_rewarder(
        make_agent(), temperature=0.05, num_waypoints=4, target_update_steps=10_000
    )
    rewarder = rewarder._replace(rewards=jax.jit(rewarder.rewards))
    state = rewarder.init(jax.random.key(0), make_spec(expert_steps=steps), params)
    first = make_episode(random_frames(1, steps + 1))
    state = rewarder.observe(state, params, first, experts)
    assert state.scale == 1.0
    assert rewarder.summary(state) == {}
    assert rewarder.plan is None

    def rewards(frames):
        episode = make_episode(np.asarray(frames))
        return np.asarray(rewarder.rewards(state, params, episode, experts))

    played = rewards(frames[1])
    assert played.shape == (steps,)
    np.testing.assert_allclose(played[-1], 1.0, atol=1e-2)
    assert rewards(frames[1][::-1]).max() < 0.7
    # The demonstration with the larger return is the one that counts: the short one
    # is covered at its own fifth frame, and then held.
    held = np.concatenate([frames[0][:5], np.repeat(frames[0][4:5], 7, axis=0)])
    np.testing.assert_allclose(rewards(held)[3:], 1.0, atol=1e-2)
