"""PatchAIL, LAIfO and GAIfO: what they judge, when they reward, that they learn."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, AgentView
from jaxil.maths.types import Batch, ExpertBatch, Window
from jaxil.native import build
from jaxil.networks.agent import critic_features
from jaxil.networks.discriminator import PatchDiscriminator
from tests.tiny_agent import (
    ACTION_DIM,
    FEATURE_DIM,
    NETWORKS,
    SIDE,
    make_agent,
    make_episode,
    make_params,
    make_spec,
    random_actions,
    random_frames,
)

STEPS, BATCH = 6, 8
SPEC, PARAMS = make_spec(expert_steps=4), make_params(0)
OWN = {
    "patchail": {"variant": "weighted", "width": 2},
    "laifo": {"hidden_dim": 16, "reward": "logit"},
    "gaifo": {"hidden_dim": 16},
}
each_method = pytest.mark.parametrize("method", sorted(OWN))


@functools.cache
def make_rewarder(method, relabels=True, **changes):
    rewarder = methods.load(method, "make_rewarder")(
        make_agent(shift_padding=1),
        learning_rate=1e-2,
        gradient_penalty=1.0,
        batch_size=BATCH,
        relabels=relabels,
        **OWN[method] | changes,
    )
    return rewarder._replace(rewards=jax.jit(rewarder.rewards))


@functools.cache
def first_state(method):
    rewarder = make_rewarder(method)

    def first(params, episode):
        state = rewarder.init(jax.random.key(0), SPEC, params)
        return rewarder.observe(state, params, episode, None)

    return jax.jit(first)(PARAMS, make_episode(random_frames(9, 3)))


def rewards_of(method, state, frames, **changes):
    rewarder = make_rewarder(method, **changes)
    return np.asarray(rewarder.rewards(state, PARAMS, make_episode(frames), None))


@each_method
def test_reward_t_judges_o_t_and_o_t_plus_1_in_their_order(method):
    state = first_state(method)
    frames = random_frames(0, STEPS + 1)
    plain = rewards_of(method, state, frames)
    assert plain.shape == (STEPS,)
    for special in (0, 3, STEPS):
        other = frames.copy()
        other[special] = random_frames(1, 1)[0]
        changed = np.abs(rewards_of(method, state, other) - plain) > 1e-6
        expected = [t for t in range(STEPS) if t <= special <= t + 1]
        np.testing.assert_array_equal(np.flatnonzero(changed), expected)
    backwards = rewards_of(method, state, frames[::-1])[::-1]
    assert np.abs(backwards - plain).min() > 1e-6


@each_method
def test_a_relabelled_window_is_rewarded_as_its_episode(method):
    rewarder, state = make_rewarder(method), first_state(method)
    frames = random_frames(0, STEPS + 1)
    starts, n = np.array([0, 2, 3]), 3
    window = Window(
        frames[starts[:, None] + np.arange(n)], np.zeros((3, n, 2)), np.ones((3, n))
    )
    batch = Batch(None, None, None, None, frames[starts + n], window=window)
    assert rewarder.relabel is not None
    relabelled = rewarder.relabel(state, PARAMS, batch)
    rewards = rewards_of(method, state, frames)
    np.testing.assert_allclose(
        relabelled, rewards[starts[:, None] + np.arange(n)], rtol=1e-4, atol=1e-5
    )


@each_method
def test_rewards_are_relabelled_or_stored_and_then_refreshed(method):
    relabelled, stored = (make_rewarder(method, relabels) for relabels in (True, False))
    assert relabelled.rewards_changed is None
    assert stored.relabel is None
    assert stored.rewards_changed is not None
    assert stored.rewards_changed(first_state(method))


@each_method
def test_expert_above_agent_after_learning(method):
    rewarder, state = make_rewarder(method), first_state(method)
    update = jax.jit(rewarder.update)
    # Each frame looks alike for both: only what follows what differs.
    dark, bright = (
        jnp.asarray(random_frames(seed, BATCH, low=low, high=low + 60))
        for seed, low in ((0, 0), (1, 190))
    )
    features = [
        critic_features(NETWORKS, PARAMS.encoder, PARAMS.critic, observation)
        for observation in (bright, dark)
    ]
    actions = jnp.asarray(random_actions(0, BATCH))
    poison = jnp.full((BATCH, SIDE, SIDE, 3), jnp.nan)
    view = AgentView(bright, features[0], actions, poison, dark, features[1])
    expert = ExpertBatch(dark, actions, bright)
    losses = []
    for number in range(40):
        key = jax.random.fold_in(jax.random.key(1), number)
        state, metrics = update(state, PARAMS, view, expert, key)
        losses.append(metrics["discriminator/loss"])
        assert set(metrics) == set(methods.DISCRIMINATOR_METRICS)
    assert losses[-1] < losses[0] - 0.1
    assert (
        metrics["discriminator/expert_logit"] > 0 > metrics["discriminator/agent_logit"]
    )
    # The expert brightens at even steps, the agent darkens at odd ones.
    frames = np.stack([dark, bright], axis=1).reshape(-1, SIDE, SIDE, 3)
    rewards = rewards_of(method, state, frames)
    assert rewards[0::2].min() > rewards[1::2].max()
    if method == "patchail":
        state, _ = update(first_state(method), PARAMS, view, expert, key)
        both = jnp.concatenate([dark, bright], axis=-1) / 255.0  # not augmented
        logits = PatchDiscriminator(width=2).apply(state.params, both)
        expected = np.mean(jax.nn.sigmoid(jnp.asarray(logits)), axis=0)
        expected /= expected.sum()
        np.testing.assert_allclose(state.expert_patches, expected, rtol=1e-4)
        assert np.ptp(expected) > 1e-3  # not as at the start
    other = expert._replace(observation=dark[:4])
    with pytest.raises(AssertionError):
        rewarder.update(state, PARAMS, view, other, jax.random.key(0))


def test_the_encoder_in_c_changes_no_update():
    # Only the penalty needs second derivatives; the rest may use the encoder in C.
    assert build.problem() is None
    encoder = NETWORKS.encoder.clone(channels=(32,))
    frames = [jnp.asarray(random_frames(seed, BATCH)) for seed in range(4)]
    features = jnp.zeros((BATCH, FEATURE_DIM))
    actions = jnp.zeros((BATCH, ACTION_DIM))
    view = AgentView(frames[0], features, actions, frames[0], frames[1], features)
    arguments = PARAMS, view, ExpertBatch(frames[2], actions, frames[3])
    ends, seen = [], []
    for native in (False, True):
        networks = NETWORKS._replace(encoder=encoder.clone(native=native))
        rewarder = methods.load("gaifo", "make_rewarder")(
            AgentSpec(networks, frame_stack=1, shift_padding=1),
            hidden_dim=16,
            learning_rate=1e-3,
            gradient_penalty=10.0,
            batch_size=BATCH,
            relabels=True,
        )
        start = state = rewarder.init(jax.random.key(0), SPEC, PARAMS)
        traced = jax.jit(rewarder.update).trace(state, *arguments, jax.random.key(1))
        seen.append("jaxil_encode" in str(traced.jaxpr))
        update = traced.lower().compile()
        for number in range(5):
            key = jax.random.fold_in(jax.random.key(1), number)
            state, _ = update(state, *arguments, key)
        moved = jax.tree.map(lambda x, y: x - y, state.params, start.params)
        ends.append(moved)
    assert seen == [False, True]
    chex.assert_trees_all_close(*ends, atol=1e-4)
    assert min(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(ends[0])) > 4e-4


def test_laifo_decides_where_the_logit_is_above_zero():
    state = first_state("laifo")
    frames = random_frames(0, STEPS + 1)
    middle = np.median(rewards_of("laifo", state, frames))
    params = jax.tree.map(lambda leaf: leaf - middle * (leaf.size == 1), state.params)
    state = state.replace(params=params)
    logits = rewards_of("laifo", state, frames)
    decisions = rewards_of("laifo", state, frames, reward="decision")
    np.testing.assert_array_equal(decisions, logits > 0)
    assert decisions.tolist().count(1.0) == STEPS / 2
