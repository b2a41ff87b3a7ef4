"""The update step: which loss moves what, keys, schedules, compilation."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxil.learner.state import init_module
from jaxil.learner.update import make_update_step
from jaxil.native import build
from jaxil.networks.agent import apply
from tests.learner.small_learner import (
    BATCH,
    CHANNELS,
    NETWORKS,
    PDAC,
    PSIL,
    SIDE,
    any_difference,
    assert_identical,
    jitted,
    make_batch,
    make_expert,
    make_learner,
    make_state,
    plain_shift,
)
from tests.tiny_agent import make_episode, make_experts


def test_only_the_critic_loss_moves_encoder_and_critic():
    # Values of zero at reward zero: the critic loss and its gradient vanish, while
    # actor and discriminator go on learning.
    learner = make_learner(PDAC, pre_tanh_penalty=1.0)
    state = make_state(learner)

    def zero_heads(params):
        layers = dict(params["params"])
        for name in ("value_1", "value_2"):
            output = jax.tree.map(jnp.zeros_like, layers[name]["output"])
            layers[name] = {**layers[name], "output": output}
        return {"params": layers}

    critic = state.critic.replace(params=zero_heads(state.critic.params))
    state = state.replace(critic=critic, target_critic=zero_heads(state.target_critic))
    batch = make_batch(0)._replace(reward=np.zeros(BATCH, np.float32))
    after = state
    for _ in range(3):
        after, metrics = jitted(learner)(after, batch, make_expert(0))
    assert metrics["critic/loss"] == 0.0
    assert_identical(after.encoder.params, state.encoder.params)
    assert_identical(after.critic.params, state.critic.params)
    assert any_difference(after.actor.params, state.actor.params)
    assert any_difference(after.rewarder.params, state.rewarder.params)


def test_the_actor_moves_neither_encoder_nor_critic():
    # Without a bootstrap, the actor has no part in the critic loss: whatever the
    # actor is, encoder and critic must come out the same to the last bit.
    learner = make_learner()
    state = make_state(learner)
    other = make_state(learner, seed=7)
    batch = make_batch(0)._replace(discount=np.zeros(BATCH, np.float32))
    first, _ = jitted(learner)(state, batch, None)
    second, _ = jitted(learner)(state.replace(actor=other.actor), batch, None)
    for name in ("encoder", "critic", "target_critic"):
        assert_identical(getattr(first, name), getattr(second, name))
    assert any_difference(first.actor.params, second.actor.params)
    assert any_difference(first.encoder.params, state.encoder.params)


def test_the_pre_tanh_penalty_is_a_mean_square():
    # Adam's statistics hold the gradient itself: mu = 0.1 g after one step.
    moments = []
    for weight in (0.0, 2.0):
        learner = make_learner(pre_tanh_penalty=weight)
        state = make_state(learner)
        after, _ = jitted(learner)(state, make_batch(0), None)
        moments.append(after.actor.opt_state[0].mu)
    shift_key = jax.random.split(jax.random.fold_in(state.key, 0), 5)[0]
    shifted = plain_shift(make_batch(0).observation, shift_key)
    z = apply(NETWORKS.encoder, state.encoder.params, shifted)
    gradient = jax.grad(lambda w: jnp.mean(apply(NETWORKS.actor, w, z) ** 2))(
        state.actor.params
    )
    difference = jax.tree.map(lambda a, b: b - a, *moments)
    expected = jax.tree.map(lambda g: 0.1 * 2.0 * g, gradient)
    chex.assert_trees_all_close(difference, expected, atol=1e-5)


def test_draws_depend_on_the_number_of_the_update_alone():
    # Without a bootstrap the noise plays no part: what differs is the shift.
    learner = make_learner()
    state = make_state(learner)
    batch = make_batch(0)._replace(discount=np.zeros(BATCH, np.float32))
    first, _ = jitted(learner)(state, batch, None)
    again, _ = jitted(learner)(state, batch, None)
    assert_identical(first, again)
    later = state.replace(num_updates=jnp.asarray(5, jnp.int32))
    other, _ = jitted(learner)(later, batch, None)
    assert any_difference(first.encoder.params, other.encoder.params)
    assert (first.num_updates, other.num_updates) == (1, 6)
    assert_identical(first.key, state.key)


@pytest.mark.parametrize(("num_updates", "std"), [(0, 1.0), (4, 0.6), (50, 0.0)])
def test_noise_follows_the_number_of_the_update(num_updates, std):
    learner = make_learner()
    state = make_state(learner).replace(num_updates=jnp.asarray(num_updates, jnp.int32))
    _, metrics = jitted(learner)(state, make_batch(0), None)
    np.testing.assert_allclose(metrics["exploration_std"], std, atol=1e-6)


def test_nothing_moves_once_the_learning_rate_has_fallen_to_zero():
    learner = make_learner(learning_rate=optax.linear_schedule(1e-3, 0.0, 2))
    optimiser, start = learner.optimiser, make_state(learner)
    step = jitted(learner)
    states = [
        start.replace(  # `make_state` knows constant rates alone
            encoder=init_module(start.encoder.params, optimiser),
            critic=init_module(start.critic.params, optimiser),
            actor=init_module(start.actor.params, optimiser),
        )
    ]
    for seed in range(3):
        states.append(step(states[-1], make_batch(seed), None)[0])
    for one, other, moves in ((0, 1, True), (1, 2, True), (2, 3, False)):
        before, after = states[one], states[other]
        assert any_difference(before.encoder.params, after.encoder.params) == moves
        assert any_difference(before.critic.params, after.critic.params) == moves
        assert any_difference(before.actor.params, after.actor.params) == moves


@pytest.mark.parametrize(
    ("rewarder", "expert"),
    [(PDAC, make_expert), (PSIL, lambda seed: None)],
    ids=["pdac", "psil"],
)
def test_compiles_once_and_donates_its_state(rewarder, expert):
    learner = make_learner(rewarder)
    chex.clear_trace_counter()
    counted = chex.assert_max_traces(make_update_step(learner), n=1)
    step = jax.jit(counted, donate_argnums=0)
    observe = jax.jit(learner.rewarder.observe)
    state = make_state(learner)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (3, 4, SIDE, SIDE, CHANNELS // 2), dtype=np.uint8)
    episode, experts = make_episode(frames[0]), make_experts(frames[1:])
    for seed in range(3):
        old = state
        state, _ = step(state, make_batch(seed), expert(seed))
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(old.params))
        # An episode in between must not change the state's types.
        observed = observe(state.rewarder, state.params, episode, experts)
        state = state.replace(rewarder=observed)
    chex.assert_tree_all_finite(state.params)


def test_rejects_a_column_of_rewards():
    learner = make_learner()
    batch = make_batch(0)._replace(reward=np.zeros((BATCH, 1), np.float32))
    with pytest.raises(AssertionError):
        make_update_step(learner)(make_state(learner), batch, None)


def test_native_convolutions_learn_the_same_over_50_updates():
    # Sums are taken in another order, so rounding differs, and Adam magnifies what
    # differs in small gradients; 50 updates of 3e-3 keep it below 1e-4.
    assert build.problem() is None
    encoder = NETWORKS.encoder.clone(channels=(32, 32))
    networks = [
        NETWORKS._replace(encoder=encoder.clone(native=own)) for own in (False, True)
    ]
    learners = [make_learner(networks=each) for each in networks]
    states = [make_state(learner) for learner in learners]
    program = jax.make_jaxpr(make_update_step(learners[1]))
    assert "jaxil_encode" in str(program(states[1], make_batch(0), None))
    for number in range(50):
        batch = make_batch(number)
        states = [
            jitted(learner)(state, batch, None)[0]
            for learner, state in zip(learners, states)
        ]
    chex.assert_trees_all_close(
        states[0].params, states[1].params, rtol=1e-3, atol=1e-4
    )
    # Not for want of learning: what was learned is far larger than the tolerance.
    start = make_state(learners[0]).params
    encoders = start.encoder, states[0].params.encoder
    moved = jax.tree.map(lambda a, b: float(jnp.max(jnp.abs(a - b))), *encoders)
    assert min(jax.tree.leaves(moved)) > 2e-2
