"""DAC on pixels: sign, alignment, relabelling, and its separate encoder."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.learner.rewarder import AgentView
from jaxil.maths.types import Batch, ExpertBatch, Window
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import PixelDiscriminator
from jaxil.rewarders import dac
from tests.tiny_agent import (
    FEATURE_DIM,
    NETWORKS,
    NOBODY,
    SIDE,
    make_agent,
    make_episode,
    make_spec,
)

STACK, BATCH = 2, 8
SPEC = make_spec(expert_steps=4, frame_stack=STACK)
SHAPE = SPEC.observation_shape
NO_BATCH = Batch(None, None, None, None, None)


@functools.cache
def make_rewarder():
    rewarder = dac.make_rewarder(
        make_agent(frame_stack=STACK),
        hidden_dim=16,
        learning_rate=3e-3,
        gradient_penalty=1.0,
        batch_size=BATCH,
    )
    return rewarder._replace(update=jax.jit(rewarder.update))


def relabel(state, window):
    rewarder = make_rewarder()
    assert rewarder.relabel is not None
    return rewarder.relabel(state, NOBODY, NO_BATCH._replace(window=window))


def sample(seed, count, low=0, high=256, shape=SHAPE):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(low, high, (count, *shape), dtype=np.uint8)
    return pixels, rng.uniform(-1, 1, (count, 2)).astype(np.float32)


def view(observation, action):
    # What is shifted or belongs to the agent's networks must not matter.
    poison = jnp.full(observation.shape, jnp.nan)
    return AgentView(poison, jnp.full((len(action), 5), jnp.nan), action, observation)


def learn(expert, agent, steps=200):
    rewarder = make_rewarder()
    state = rewarder.init(jax.random.key(0), SPEC, NOBODY)
    rng = np.random.default_rng(0)
    metrics = {}
    for number in range(steps):
        ours, theirs = rng.integers(0, len(agent[0]), (2, BATCH))
        state, metrics = rewarder.update(
            state,
            NOBODY,
            view(*(x[ours] for x in agent)),
            ExpertBatch(*(x[theirs] for x in expert)),
            jax.random.fold_in(jax.random.key(1), number),
        )
    return state, metrics


@pytest.mark.parametrize("told_by", ["pixels", "actions"])
def test_expert_above_zero_above_agent_after_learning(told_by):
    expert, agent = sample(0, 64, 0, 100), sample(1, 64, 156, 256)
    if told_by == "actions":
        expert = (agent[0], np.full((64, 2), 0.9, np.float32))
        agent = (agent[0], np.full((64, 2), -0.9, np.float32))
    state, metrics = learn(expert, agent)
    assert (
        metrics["discriminator/expert_logit"] > 0 > metrics["discriminator/agent_logit"]
    )
    relabelled = [
        relabel(state, Window(o[:, None], a[:, None], None)) for o, a in (expert, agent)
    ]
    assert np.mean(relabelled[0]) > 0.1
    assert np.mean(relabelled[1]) < -0.1


def test_reward_t_judges_observation_and_action_t():
    rewarder = make_rewarder()
    state = rewarder.init(jax.random.key(0), SPEC, NOBODY)
    frames, actions = sample(2, 6, shape=(SIDE, SIDE, 3))

    def rewards(frames, actions):
        episode = make_episode(frames, actions)
        return np.asarray(rewarder.rewards(state, NOBODY, episode, None))

    before = rewards(frames, actions[:5])
    assert before.shape == (5,)
    for t in range(5):
        changed = actions[:5].copy()
        changed[t] = -changed[t]
        after = rewards(frames, changed)
        assert np.flatnonzero(after != before).tolist() == [t]
    other = frames.copy()
    other[5] = 255 - other[5]  # what the last action led to
    after = rewards(other, actions[:5])
    np.testing.assert_array_equal(after, before)


def test_a_window_is_rewarded_as_its_transitions_are_one_by_one():
    rewarder = make_rewarder()
    state = rewarder.init(jax.random.key(0), SPEC, NOBODY)
    pixels, actions = sample(3, 6)
    window = Window(
        pixels.reshape(2, 3, *SHAPE), actions.reshape(2, 3, 2), np.ones((2, 3))
    )
    together = relabel(state, window)
    single = relabel(state, Window(pixels[:, None], actions[:, None], None))
    assert together.shape == (2, 3)
    np.testing.assert_allclose(together.reshape(-1, 1), single, rtol=1e-4, atol=1e-5)


def test_the_penalty_is_on_pixels_in_zero_to_one_and_actions():
    # Where expert and agent are the same, so is every point between them.
    rewarder, (pixels, actions) = make_rewarder(), sample(4, BATCH)
    state = rewarder.init(jax.random.key(0), SPEC, NOBODY)
    _, metrics = rewarder.update(
        state,
        NOBODY,
        view(pixels, actions),
        ExpertBatch(pixels, actions),
        jax.random.key(1),
    )
    discriminator = PixelDiscriminator(NETWORKS.encoder, FEATURE_DIM, 16)

    def logit(pixels, action):
        inputs = 255.0 * pixels[None], action[None]
        return apply(discriminator, state.params, *inputs)[0]

    gradients = jax.vmap(jax.grad(logit, (0, 1)))(pixels / np.float32(255), actions)
    squares = sum(np.sum(g.reshape(BATCH, -1) ** 2, axis=1) for g in gradients)
    expected = np.mean((np.sqrt(squares) - 1.0) ** 2)
    np.testing.assert_allclose(metrics["discriminator/penalty"], expected, rtol=1e-4)
