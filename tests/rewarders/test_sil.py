"""SIL on pixels: what its embedding climbs, and its rewards."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.learner.rewarder import AgentView
from jaxil.maths.types import ExpertBatch
from jaxil.rewarders import sil
from jaxil.rewarders.matching import make_matching
from tests.tiny_agent import (
    NOBODY,
    make_agent,
    make_episode,
    make_experts,
    make_play,
    make_spec,
    random_frames,
)

STEPS, BATCH = 5, 8
SPEC = make_spec(expert_steps=STEPS)
EXPERTS = make_experts(random_frames(50, 2, STEPS + 1))


@functools.cache
def make_rewarder(alignment="transport"):
    rewarder = sil.make_rewarder(
        make_agent(),
        cost="cosine",
        alignment=alignment,
        epsilon=0.05,
        num_iterations=200,
        return_scale=10.0,
        learning_rate=3e-3,
        batch_size=BATCH,
    )
    return rewarder._replace(
        update=jax.jit(rewarder.update),
        observe=jax.jit(rewarder.observe),
        rewards=jax.jit(rewarder.rewards),
    )


def start():
    return make_rewarder().init(jax.random.key(0), SPEC, NOBODY)


def climb(state, agent, expert, steps):
    poison = jnp.full(agent.shape, jnp.nan)
    view = AgentView(
        poison, jnp.full((BATCH, 5), jnp.nan), jnp.zeros((BATCH, 2)), agent
    )
    distances = []
    for _ in range(steps):
        state, metrics = make_rewarder().update(
            state,
            NOBODY,
            view,
            ExpertBatch(expert, np.zeros((BATCH, 2))),
            jax.random.key(1),
        )
        distances.append(float(metrics["sinkhorn/distance"]))
    return state, distances


def test_the_embedding_learns_to_tell_apart():
    _, distances = climb(start(), random_frames(0, BATCH), random_frames(1, BATCH), 40)
    assert distances[-1] > distances[0] + 0.1


def test_the_embedding_learns_alike_whatever_the_rewards_align():
    # Samples of a batch have no order in time, by which they could be paired.
    agent, expert = (jnp.asarray(random_frames(seed, BATCH)) for seed in (0, 1))
    key = jax.random.key(1)
    view = AgentView(agent, jnp.zeros((BATCH, 5)), jnp.zeros((BATCH, 2)), agent)
    batch = ExpertBatch(expert, np.zeros((BATCH, 2)))
    transported, timed = (
        make_rewarder(alignment).update(start(), NOBODY, view, batch, key)[1]
        for alignment in ("transport", "time")
    )
    assert transported["sinkhorn/distance"] == timed["sinkhorn/distance"]


def test_rewards_fall_where_the_embedding_has_learned():
    episode, play = (
        make_episode(random_frames(2, STEPS + 1)),
        make_play(make_rewarder()),
    )
    rewards, state = play(start(), NOBODY, episode, EXPERTS)
    before = jnp.sum(rewards)
    agent = np.resize(episode.frames, (BATCH, *episode.frames.shape[1:]))
    expert = np.resize(EXPERTS.frames.reshape(-1, *agent.shape[1:]), agent.shape)
    learned, _ = climb(state, agent, expert, 40)
    # Rewards follow at the next episode's end, so that all of one round agree.
    stored = make_rewarder().rewards(learned, NOBODY, episode, EXPERTS)
    np.testing.assert_allclose(stored, rewards, rtol=1e-5)
    rewards, _ = play(learned, NOBODY, episode, EXPERTS)
    assert jnp.sum(rewards) < before


def test_the_gradient_is_that_of_the_distance():
    # It is exact for the distance with its entropy; without, and with a small epsilon,
    # the direction is the same.
    rng = np.random.default_rng(0)
    agent, expert = jnp.asarray(rng.normal(size=(2, 6, 4)), jnp.float32)
    tight = make_matching(
        cost="cosine", alignment="transport", epsilon=0.005, num_iterations=2000
    )
    distance = jax.jit(lambda x: sil.batch_distance(tight, x, expert))
    gradient = jax.grad(distance)(agent)
    numeric = np.zeros(agent.shape)
    for index in np.ndindex(*agent.shape):
        step = jnp.zeros_like(agent).at[index].set(1e-2)
        numeric[index] = (distance(agent + step) - distance(agent - step)) / 2e-2
    cosine = np.sum(gradient * numeric) / (
        np.linalg.norm(gradient) * np.linalg.norm(numeric)
    )
    assert cosine > 0.99


def test_the_first_episode_returns_minus_ten_and_the_scale_stays():
    rewarder = make_rewarder()
    first, other = (make_episode(random_frames(n, STEPS + 1)) for n in (3, 4))
    play = make_play(rewarder)
    rewards, state = play(start(), NOBODY, first, EXPERTS)
    assert rewards.shape == (STEPS,)
    np.testing.assert_allclose(jnp.sum(rewards), -10.0, rtol=1e-4)
    rewards, later = play(state, NOBODY, other, EXPERTS)
    assert later.scale == state.scale
    assert not np.isclose(jnp.sum(rewards), -10.0)


def test_the_plan_matches_a_demonstration_with_itself():
    make_plan, episode = make_rewarder().plan, make_episode(EXPERTS.frames[1])
    assert make_plan is not None
    state = make_rewarder().observe(start(), NOBODY, episode, EXPERTS)
    plan, closest = make_plan(state, NOBODY, episode, EXPERTS)
    assert int(closest) == 1
    assert plan.shape == (STEPS + 1, STEPS + 1)
    assert np.all(np.argmax(plan, axis=1) == np.arange(STEPS + 1))
