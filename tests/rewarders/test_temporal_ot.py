"""TemporalOT: context and band by hand, and what order is worth to it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.maths import transport
from jaxil.rewarders import psil, temporal_ot
from tests.tiny_agent import (
    make_agent,
    make_episode,
    make_experts,
    make_params,
    make_play,
    make_spec,
    random_frames,
)

STEPS = 11
SETTINGS = {"epsilon": 0.01, "num_iterations": 100, "target_update_steps": 10_000}
EXPERTS = make_experts(random_frames(0, 2, STEPS + 1))
PARAMS = make_params(0)


def random_cost(seed, *shape):
    return np.random.default_rng(seed).uniform(0, 2, shape).astype(np.float32)


@functools.cache
def make_rewarder(context_length, band_steps):
    return temporal_ot.make_rewarder(
        make_agent(),
        context_length=context_length,
        band_steps=band_steps,
        return_scale=10.0,
        **SETTINGS,
    )


PSIL = psil.make_rewarder(
    make_agent(),
    cost="cosine",
    alignment="transport",
    return_scale=10.0,
    num_components=0,
    **SETTINGS,
)
compiled = functools.cache(make_play)


def rewards_after_the_first(rewarder, frames=None):
    """Rewards of a run's first episode, of noise, or of one that follows it."""
    state = rewarder.init(jax.random.key(0), make_spec(expert_steps=STEPS), PARAMS)
    play, first = compiled(rewarder), make_episode(random_frames(1, STEPS + 1))
    rewards, state = play(state, PARAMS, first, EXPERTS)
    if frames is not None:
        rewards, _ = play(state, PARAMS, make_episode(np.asarray(frames)), EXPERTS)
    return np.asarray(rewards)


def masses_of(cost):
    return [transport.uniform_mass(jnp.array(size), size) for size in cost.shape]


def test_context_cost_by_hand():
    cost = jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    three = jnp.array(3)
    averaged = temporal_ot.context_cost(cost, three, three, context_length=2)
    # (1 + 5) / 2, (2 + 6) / 2, 3 alone, and so on; the last row stands alone.
    np.testing.assert_allclose(averaged, [[3, 4, 3], [6, 7, 6], [7, 8, 9]])
    # Longer than the episode: whole diagonals.
    averaged = temporal_ot.context_cost(cost, three, three, context_length=5)
    np.testing.assert_allclose(averaged, [[5, 4, 3], [6, 7, 6], [7, 8, 9]])


def test_padding_is_no_context():
    cost = jnp.asarray(random_cost(0, 7, 6))
    own = jnp.array(5), jnp.array(4)
    padded = temporal_ot.context_cost(cost, *own, context_length=3)
    alone = temporal_ot.context_cost(cost[:5, :4], *own, context_length=3)
    np.testing.assert_allclose(padded[:5, :4], alone, rtol=1e-6)
    assert np.all(padded[5:] == 0.0)
    assert np.all(padded[:, 4:] == 0.0)


@pytest.mark.parametrize("shape", [(8, 8), (6, 8)])
def test_no_mass_moves_outside_the_band(shape):
    cost = jnp.asarray(random_cost(1, *shape))
    masses = masses_of(cost)
    plan = temporal_ot.band_plan(
        cost, *masses, band_steps=2, epsilon=0.05, num_iterations=300
    )
    away = np.abs(np.subtract.outer(np.arange(shape[0]), np.arange(shape[1])))
    assert np.all(plan[away > 2] == 0.0)
    assert np.all(plan[away == 2] >= 0.0)
    np.testing.assert_allclose(np.sum(plan, axis=1), 1 / shape[0], rtol=1e-4)
    np.testing.assert_allclose(np.sum(plan, axis=0), masses[1], atol=2e-3)


def test_a_band_of_no_width_pairs_equal_times():
    cost = jnp.asarray(random_cost(2, 5, 5))
    plan = temporal_ot.band_plan(
        cost, *masses_of(cost), band_steps=0, epsilon=0.01, num_iterations=10
    )
    np.testing.assert_allclose(plan, np.eye(5) / 5, rtol=1e-5)


def test_a_much_longer_episode_still_gets_finite_rewards():
    cost = jnp.asarray(random_cost(3, 9, 4))
    plan = temporal_ot.band_plan(
        cost, *masses_of(cost), band_steps=1, epsilon=0.01, num_iterations=100
    )
    np.testing.assert_allclose(np.sum(plan, axis=1), 1 / 9, rtol=1e-2)


def test_without_context_and_band_it_is_psil():
    ours = rewards_after_the_first(make_rewarder(1, STEPS + 1))
    np.testing.assert_allclose(ours, rewards_after_the_first(PSIL), rtol=1e-4)
    np.testing.assert_allclose(np.sum(ours), -10.0, rtol=1e-4)
    banded = rewards_after_the_first(make_rewarder(3, 2))
    np.testing.assert_allclose(np.sum(banded), -10.0, rtol=1e-4)
    assert np.abs(banded - ours).max() > 1e-2


def test_only_psil_takes_a_demonstration_backwards_for_one():
    frames = EXPERTS.frames[1]
    forwards, backwards = (
        {
            name: float(np.sum(rewards_after_the_first(rewarder, order)))
            for name, rewarder in (("ours", make_rewarder(3, 2)), ("psil", PSIL))
        }
        for order in (frames, frames[::-1])
    )
    # The first episode, of noise, returned -10.
    assert min(forwards.values()) > -0.5
    assert backwards["psil"] > -0.5
    assert backwards["ours"] < -5.0
