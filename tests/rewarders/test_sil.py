"""SIL on pixels: what its embedding climbs, and its rewards."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.learner.rewarder import AgentView
from jaxil.maths.types import ExpertBatch, ExpertEpisodes
from jaxil.rewarders.matching import make_matching
from jaxil.rewarders.sil import batch_distance, make_sil_rewarder
from tests.tiny_agent import NETWORKS, NOBODY, make_episode, make_spec, random_frames

STEPS, BATCH = 5, 8
SPEC = make_spec(expert_steps=STEPS)
MATCHING = make_matching(
    cost="cosine", alignment="transport", epsilon=0.05, num_iterations=200
)


@functools.cache
def make_rewarder():
    rewarder = make_sil_rewarder(
        NETWORKS,
        matching=MATCHING,
        feature_dim=5,
        learning_rate=3e-3,
        batch_size=BATCH,
        return_scale=10.0,
        frame_stack=1,
    )
    return rewarder._replace(
        update=jax.jit(rewarder.update), rewards=jax.jit(rewarder.rewards)
    )


def make_experts():
    frames = random_frames(50, 2, STEPS + 1)
    return ExpertEpisodes(frames, np.full(2, STEPS + 1), np.zeros((2, 0, 0)))


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


def test_rewards_fall_where_the_embedding_has_learned():
    frames, experts = random_frames(2, STEPS + 1), make_experts()
    state = start().replace(scale=jnp.ones(()))

    def total(state):
        return float(
            jnp.sum(
                make_rewarder().rewards(state, NOBODY, make_episode(frames), experts)[0]
            )
        )

    before = total(state)
    agent = np.resize(frames, (BATCH, *frames.shape[1:]))
    expert = np.resize(experts.frames.reshape(-1, *frames.shape[1:]), agent.shape)
    after, _ = climb(state, agent, expert, 40)
    assert total(after) < before


def test_the_gradient_is_that_of_the_distance():
    # Of the regularised distance: the entropy counts too, so the two are compared in
    # direction, where epsilon is small.
    rng = np.random.default_rng(0)
    agent, expert = jnp.asarray(rng.normal(size=(2, 6, 4)), jnp.float32)
    tight = make_matching(
        cost="cosine", alignment="transport", epsilon=0.005, num_iterations=2000
    )
    gradient = jax.grad(lambda x: batch_distance(tight, x, expert))(agent)
    numeric = np.zeros(agent.shape)
    for index in np.ndindex(*agent.shape):
        step = jnp.zeros_like(agent).at[index].set(1e-2)
        up, down = (batch_distance(tight, agent + s, expert) for s in (step, -step))
        numeric[index] = (up - down) / 2e-2
    cosine = np.sum(gradient * numeric) / (
        np.linalg.norm(gradient) * np.linalg.norm(numeric)
    )
    assert cosine > 0.99


def test_the_first_episode_returns_minus_ten_and_the_scale_stays():
    rewarder, experts = make_rewarder(), make_experts()
    rewards, state = rewarder.rewards(
        start(), NOBODY, make_episode(random_frames(3, STEPS + 1)), experts
    )
    assert rewards.shape == (STEPS,)
    np.testing.assert_allclose(jnp.sum(rewards), -10.0, rtol=1e-4)
    other, later = rewarder.rewards(
        state, NOBODY, make_episode(random_frames(4, STEPS + 1)), experts
    )
    assert later.scale == state.scale
    assert not np.isclose(jnp.sum(other), -10.0)


def test_the_plan_matches_a_demonstration_with_itself():
    experts = make_experts()
    make_plan = make_rewarder().plan
    assert make_plan is not None
    plan = make_plan(start(), NOBODY, make_episode(experts.frames[1]), experts)
    assert plan.shape == (STEPS + 1, STEPS + 1)
    assert np.all(np.argmax(plan, axis=1) == np.arange(STEPS + 1))
