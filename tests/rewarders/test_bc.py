"""Behavioural cloning: its loss, what it moves, and that it copies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxil.learner.policy import make_mean_action
from jaxil.learner.rewarder import AgentSpec, Spec
from jaxil.learner.update import init_train_state
from jaxil.maths import losses
from jaxil.maths.types import ExpertBatch
from jaxil.rewarders import bc
from tests.rewarders.small_world import learner_with
from tests.tiny_agent import make_tiny_networks

SHAPE = (12, 12, 3)
SETTINGS = {"batch_size": 16, "std": 0.1}
NETWORKS = make_tiny_networks(feature_dim=8, hidden_dim=32, channels=(8,))


def make_learner(shift_padding=0, learning_rate=3e-3):
    rewarder = bc.make_rewarder(AgentSpec(NETWORKS, 1, shift_padding), **SETTINGS)
    return learner_with(NETWORKS, rewarder, shift_padding, learning_rate)


def make_state(learner):
    spec = Spec(2, num_demonstrations=1, expert_steps=4, observation_shape=SHAPE)
    return init_train_state(learner, jax.random.key(0), np.zeros(SHAPE, np.uint8), spec)


def make_expert(seed=0, size=16):
    rng = np.random.default_rng(seed)
    return ExpertBatch(
        rng.integers(0, 256, (size, *SHAPE), dtype=np.uint8),
        rng.uniform(-0.9, 0.9, (size, 2)).astype(np.float32),
    )


def test_the_loss_is_scipys_log_probability():
    rng = np.random.default_rng(0)
    mean, action = rng.uniform(-1, 1, (2, 6, 3)).astype(np.float32)
    expected = -stats.norm.logpdf(action, mean, 0.1).sum(axis=1).mean()
    loss = losses.cloning_loss(mean, action, std=0.1)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


def test_the_policy_copies_the_expert_and_nothing_else_moves():
    learner, expert = make_learner(learning_rate=1e-2), make_expert()
    before = make_state(learner)
    step = jax.jit(bc.make_update_step(learner, **SETTINGS))
    state, first = step(before, None, expert)
    for _ in range(200):
        state, metrics = step(state, None, expert)
    assert int(state.num_updates) == 201
    assert metrics["actor/loss"] < first["actor/loss"]
    copied = make_mean_action(NETWORKS)(
        state.encoder.params, state.actor.params, expert.observation
    )
    np.testing.assert_allclose(copied, expert.action, atol=0.1)
    for name in ("critic", "target_critic", "rewarder"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(state, name), getattr(before, name)
        )


def test_asks_for_expert_samples_and_refuses_another_number_of_them():
    learner = make_learner()
    assert learner.rewarder.expert_batch_size == 16
    step = jax.jit(bc.make_update_step(learner, **SETTINGS))
    with pytest.raises(AssertionError):
        step(make_state(learner), None, make_expert(size=4))


def test_each_update_has_shifts_of_its_own():
    expert = make_expert()
    for padding, expected in ((0, True), (2, False)):
        step = jax.jit(bc.make_update_step(make_learner(padding), **SETTINGS))
        state = make_state(make_learner(padding))
        losses_seen = [
            float(
                step(state.replace(num_updates=jnp.int32(n)), None, expert)[1][
                    "actor/loss"
                ]
            )
            for n in range(2)
        ]
        assert (losses_seen[0] == losses_seen[1]) is expected
