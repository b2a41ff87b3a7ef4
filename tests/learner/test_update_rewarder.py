"""What the update step shows to a rewarder, and takes from it."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxil.learner.update import make_update_step
from jaxil.maths.types import Window
from jaxil.networks.agent import apply, critic_features
from tests.learner.small_learner import (
    ACTIONS,
    BATCH,
    DRQV2,
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
    padded,
    plain_shift,
)


def test_the_discriminator_moves_nothing_else():
    learner = make_learner(PDAC)
    state, batch = make_state(learner), make_batch(0)
    first, _ = jitted(learner)(state, batch, make_expert(0))
    second, _ = jitted(learner)(state, batch, make_expert(1))
    assert any_difference(first.rewarder.params, second.rewarder.params)
    assert_identical(first.replace(rewarder=()), second.replace(rewarder=()))


def test_relabelled_rewards_replace_the_stored_ones():
    paid = DRQV2._replace(
        relabel=lambda state, learner, batch: batch.window.action[..., 0]
    )
    batch, rng = make_batch(0), np.random.default_rng(0)
    window = Window(
        observation=np.stack([batch.observation] * 3, axis=1),
        action=rng.normal(size=(BATCH, 3, ACTIONS)).astype(np.float32),
        weight=rng.uniform(size=(BATCH, 3)).astype(np.float32),
    )
    reward = np.sum(window.weight * window.action[..., 0], axis=1)
    relabelled, relabelled_metrics = jitted(make_learner(paid))(
        make_state(make_learner(paid)), batch._replace(window=window), None
    )
    stored, stored_metrics = jitted(make_learner())(
        make_state(make_learner()), batch._replace(reward=reward), None
    )
    chex.assert_trees_all_close(relabelled_metrics, stored_metrics, rtol=1e-5)
    chex.assert_trees_all_close(relabelled.params, stored.params, rtol=1e-4, atol=1e-6)
    _, other = jitted(make_learner())(make_state(make_learner()), batch, None)
    assert abs(other["batch/reward"] - relabelled_metrics["batch/reward"]) > 0.1


def test_a_rewarder_with_nothing_to_learn_is_left_alone():
    learner = make_learner(PSIL)
    state = make_state(learner)
    after, _ = jitted(learner)(state, make_batch(0), None)
    assert_identical(after.rewarder, state.rewarder)


def seen_by_rewarder(**changes):
    """Returns what a rewarder that remembers its arguments was given in one update."""

    def update(state, learner, agent, expert, key):
        return {"learner": learner, "agent": agent, "expert": expert}, {"spy": 1.0}

    learner = make_learner(DRQV2._replace(update=update, **changes))
    state = make_state(learner)
    batch = make_batch(0)._replace(successor=make_batch(1).observation)
    expert = make_expert(0)._replace(successor=make_expert(1).observation)
    after, metrics = jax.jit(make_update_step(learner))(state, batch, expert)
    assert metrics["spy"] == 1.0
    return state, batch, expert, after


def test_the_rewarder_sees_augmented_features_from_before_the_update():
    state, batch, _, after = seen_by_rewarder()
    seen, agent = after.rewarder["learner"], after.rewarder["agent"]
    assert_identical(seen, state.params)
    assert any_difference(after.params, state.params)
    shift_key = jax.random.split(jax.random.fold_in(state.key, 0), 5)[0]
    shifted = plain_shift(batch.observation, shift_key)
    np.testing.assert_array_equal(agent.observation, shifted)
    np.testing.assert_array_equal(agent.unshifted, batch.observation)
    np.testing.assert_array_equal(agent.action, batch.action)
    np.testing.assert_allclose(agent.features, features_of(state, shifted), atol=1e-5)
    assert agent.successor is None
    assert agent.successor_features is None
    assert agent.unshifted_successor is None


def features_of(state, observation):
    encoder, critic = state.encoder.params, state.critic.params
    return critic_features(NETWORKS, encoder, critic, jnp.asarray(observation))


def test_successors_come_augmented_with_their_features_and_change_nothing_else():
    _, _, _, without = seen_by_rewarder()
    state, batch, expert, after = seen_by_rewarder(samples_successors=True)
    agent = after.rewarder["agent"]
    assert batch.successor is not None
    crops = np.lib.stride_tricks.sliding_window_view(
        padded(batch.successor), (SIDE, SIDE), (1, 2)
    )
    crops = np.moveaxis(crops, 3, -1)  # [B, 5, 5, SIDE, SIDE, C]
    matches = np.all(
        crops == np.asarray(agent.successor)[:, None, None], axis=(3, 4, 5)
    )
    assert np.all(matches.sum(axis=(1, 2)) == 1)  # each is one of the 25 shifts
    assert len({tuple(np.argwhere(m)[0]) for m in matches}) > 1
    features = features_of(state, agent.successor)
    np.testing.assert_allclose(agent.successor_features, features, atol=1e-5)
    np.testing.assert_array_equal(agent.unshifted_successor, batch.successor)
    np.testing.assert_array_equal(after.rewarder["expert"].successor, expert.successor)
    # The learner, and what the rewarder saw before, are the same to the last bit.
    assert_identical(after.replace(rewarder=()), without.replace(rewarder=()))
    assert_identical(
        agent._replace(
            successor=None, successor_features=None, unshifted_successor=None
        ),
        without.rewarder["agent"],
    )


def test_a_term_in_the_actors_loss_pulls_the_policy_and_nothing_else():
    target = np.array([0.8, -0.8], np.float32)

    def mean_action(learner, observation):
        z = jax.lax.stop_gradient(apply(NETWORKS.encoder, learner.encoder, observation))
        return jnp.tanh(apply(NETWORKS.actor, learner.actor, z))

    def pull(state, learner, agent, expert, key):
        error = mean_action(learner, expert.observation) - target[None]
        return 100.0 * jnp.mean(error**2)

    learner, without = (
        make_learner(DRQV2._replace(actor_loss=loss), learning_rate=1e-2)
        for loss in (pull, None)
    )
    expert = make_expert(0)
    state = start = make_state(learner)
    for _ in range(150):
        state, metrics = jitted(learner)(state, make_batch(0), expert)
        assert np.isfinite(metrics["actor/loss"])
    before, after = (
        np.abs(np.asarray(mean_action(s.params, expert.observation)) - target).max()
        for s in (start, state)
    )
    assert after < 0.25 < before
    # One update with and without it: only the actor differs.
    pulled, plain = (
        jitted(each)(start, make_batch(0), expert)[0] for each in (learner, without)
    )
    assert any_difference(pulled.actor, plain.actor)
    assert_identical(pulled.replace(actor=()), plain.replace(actor=()))
