"""P-DAC: sign, alignment, whose features, and the discriminator's own step."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxil.maths.types import ExpertBatch
from jaxil.networks.agent import apply, critic_features
from jaxil.networks.discriminator import Discriminator
from tests.rewarders.small_pdac import BATCH, SPEC, STEPS, make_rewarder, make_view
from tests.tiny_agent import (
    NETWORKS,
    make_episode,
    make_params,
    random_actions,
    random_frames,
)


def rewards_of(rewarder, params, frames, actions=None, seed=0):
    state = rewarder.init(jax.random.key(seed), SPEC, params)
    actions = random_actions(0, len(frames) - 1) if actions is None else actions
    episode = make_episode(frames, actions)
    return np.asarray(rewarder.rewards(state, params, episode, None))


# Rewards -----------------------------------------------------------------------


@pytest.mark.parametrize("special", range(STEPS + 1))
def test_reward_t_is_of_observation_t_plus_1(special):
    frames = np.repeat(random_frames(0, 1), STEPS + 1, axis=0)
    rewarder, params = make_rewarder(), make_params(0)
    plain = rewards_of(rewarder, params, frames)
    assert len(plain) == STEPS
    frames[special] = random_frames(1, 1)[0]
    changed = np.abs(rewards_of(rewarder, params, frames) - plain) > 1e-4
    expected = [] if special == 0 else [special - 1]  # nothing led to o_0
    np.testing.assert_array_equal(np.flatnonzero(changed), expected)


@pytest.mark.parametrize("special", [0, 2, STEPS])
def test_a_frame_is_seen_for_as_long_as_it_is_stacked(special):
    frames = np.repeat(random_frames(0, 1), STEPS + 1, axis=0)
    rewarder, params = make_rewarder(frame_stack=3), make_params(0, 3)
    plain = rewards_of(rewarder, params, frames)
    frames[special] = random_frames(1, 1)[0]
    changed = np.abs(rewards_of(rewarder, params, frames) - plain) > 1e-4
    # It is in o_special, o_special+1 and o_special+2; reward t judges o_t+1.
    expected = [t for t in range(STEPS) if special <= t + 1 <= special + 2]
    np.testing.assert_array_equal(np.flatnonzero(changed), expected)


def test_episodes_change_no_state_but_updates_change_every_reward():
    rewarder, params = make_rewarder(), make_params(0)
    state = rewarder.init(jax.random.key(0), SPEC, params)
    episode = make_episode(random_frames(0, STEPS + 1))
    assert rewarder.observe(state, params, episode, None) is state
    assert rewarder.rewards_changed is not None
    assert rewarder.rewards_changed(state)


@pytest.mark.parametrize("special", [0, 2, STEPS])
def test_with_actions_a_reward_judges_the_pair_of_one_moment(special):
    frames = np.repeat(random_frames(0, 1), STEPS + 1, axis=0)
    actions = np.zeros((STEPS, 2), np.float32)
    rewarder, params = make_rewarder(sees_actions=True), make_params(0)
    plain = rewards_of(rewarder, params, frames, actions)
    moments = np.arange(STEPS)

    other = frames.copy()
    other[special] = random_frames(1, 1)[0]
    changed = np.abs(rewards_of(rewarder, params, other, actions) - plain) > 1e-4
    np.testing.assert_array_equal(changed, moments == special)  # never o_T

    if special < STEPS:
        actions[special] = 1.0
        changed = np.abs(rewards_of(rewarder, params, frames, actions) - plain) > 1e-4
        np.testing.assert_array_equal(changed, moments == special)


def test_the_reward_is_the_logit_of_critic_features():
    rewarder, params = make_rewarder(), make_params(0)
    frames = random_frames(0, STEPS + 1)
    state = rewarder.init(jax.random.key(0), SPEC, params)
    biased = jax.tree.map(lambda p: p + 0.1, state.params)
    state = state.replace(params=biased)
    episode = make_episode(frames)
    features = critic_features(
        NETWORKS, params.encoder, params.critic, jnp.asarray(frames[1:])
    )
    expected = apply(Discriminator(16), biased, features)
    rewards = rewarder.rewards(state, params, episode, None)
    np.testing.assert_allclose(rewards, expected, rtol=1e-4, atol=1e-4)


def test_reads_the_critics_trunk_and_nothing_of_the_actor():
    rewarder, params, other = make_rewarder(), make_params(0), make_params(1)
    frames = random_frames(0, STEPS + 1)
    rewards = rewards_of(rewarder, params, frames)
    np.testing.assert_array_equal(
        rewards_of(rewarder, params._replace(actor=other.actor), frames), rewards
    )
    layers = params.critic["params"]
    heads = {**other.critic["params"], "trunk": layers["trunk"]}
    np.testing.assert_array_equal(
        rewards_of(rewarder, params._replace(critic={"params": heads}), frames), rewards
    )
    trunk = {**layers, "trunk": other.critic["params"]["trunk"]}
    changed = rewards_of(rewarder, params._replace(critic={"params": trunk}), frames)
    assert np.abs(changed - rewards).max() > 1e-3
    changed = rewards_of(rewarder, params._replace(encoder=other.encoder), frames)
    assert np.abs(changed - rewards).max() > 1e-3


# The discriminator's step ------------------------------------------------------


def test_expert_above_zero_above_agent_after_learning():
    rewarder, params = make_rewarder(), make_params(0)
    dark, bright = random_frames(0, 64, high=100), random_frames(1, 64, low=156)
    actions = np.zeros((64, 2), np.float32)
    # The sign must follow from the labels, not from what is bright.
    for expert, agent in ((bright, dark), (dark, bright)):
        state = rewarder.init(jax.random.key(0), SPEC, params)
        view = jax.tree.map(np.asarray, make_view(params, agent, actions))
        rng = np.random.default_rng(0)
        for number in range(300):
            ours, theirs = rng.integers(0, 64, (2, BATCH))
            state, metrics = rewarder.update(
                state,
                params,
                jax.tree.map(lambda values, ours=ours: values[ours], view),
                ExpertBatch(expert[theirs], actions[theirs]),
                jax.random.fold_in(jax.random.key(1), number),
            )
        expert_rewards, agent_rewards = (
            rewarder.rewards(state, params, make_episode(frames, actions[1:]), None)
            for frames in (expert, agent)
        )
        assert np.mean(expert_rewards) > 0.1
        assert np.mean(agent_rewards) < -0.1
        assert metrics["discriminator/expert_logit"] > 0.0
        assert metrics["discriminator/agent_logit"] < 0.0
        assert metrics["discriminator/loss"] < 2.0 * np.log(2.0)


@pytest.mark.parametrize("sees_actions", [False, True])
def test_a_step_descends_cross_entropy_and_penalty(sees_actions):
    rewarder = make_rewarder(sees_actions=sees_actions)
    params = make_params(0)
    state = rewarder.init(jax.random.key(0), SPEC, params)
    view = make_view(params, random_frames(0, BATCH))
    expert = ExpertBatch(random_frames(1, BATCH), random_actions(1, BATCH))
    key = jax.random.key(2)
    after, metrics = rewarder.update(state, params, view, expert, key)

    features = critic_features(
        NETWORKS, params.encoder, params.critic, jnp.asarray(expert.observation)
    )
    agent_inputs, expert_inputs = view.features, features
    if sees_actions:
        agent_inputs = jnp.concatenate([agent_inputs, view.action], axis=1)
        expert_inputs = jnp.concatenate([expert_inputs, expert.action], axis=1)
    u = jax.random.uniform(jax.random.split(key)[1], (BATCH, 1))
    between = u * expert_inputs + (1.0 - u) * agent_inputs
    discriminator = Discriminator(16)

    def loss(weights):
        def logit(x):
            return apply(discriminator, weights, x[None])[0]

        expert_term = jax.nn.sigmoid(jax.vmap(logit)(expert_inputs))
        agent_term = jax.nn.sigmoid(jax.vmap(logit)(agent_inputs))
        entropy = -jnp.mean(jnp.log(expert_term)) - jnp.mean(jnp.log(1.0 - agent_term))
        norms = jnp.linalg.norm(jax.vmap(jax.grad(logit))(between), axis=1)
        penalty = jnp.mean((norms - 1.0) ** 2)
        return entropy + 10.0 * penalty, (entropy, penalty)

    gradients, (entropy, penalty) = jax.grad(loss, has_aux=True)(state.params)
    optimiser = optax.adam(3e-3)
    updates, _ = optimiser.update(gradients, optimiser.init(state.params))
    expected = optax.apply_updates(state.params, updates)
    np.testing.assert_allclose(metrics["discriminator/loss"], entropy, rtol=1e-4)
    np.testing.assert_allclose(metrics["discriminator/penalty"], penalty, rtol=1e-4)
    # A first step of Adam is the gradient's sign, so where the gradient is zero but
    # for rounding, nothing can be asked; its statistics hold the gradient itself.
    chex.assert_trees_all_close(
        after.opt_state[0].mu, jax.tree.map(lambda g: 0.1 * g, gradients), atol=1e-5
    )
    chex.assert_trees_all_close(after.params, expected, atol=1e-4)


def test_reads_as_many_agent_samples_as_expert_samples():
    rewarder, params = make_rewarder(), make_params(0)
    state = rewarder.init(jax.random.key(0), SPEC, params)
    expert = ExpertBatch(random_frames(1, BATCH), random_actions(1, BATCH))
    view = make_view(params, random_frames(0, 2 * BATCH))
    rest = view._replace(features=view.features.at[BATCH:].set(7.0))
    first = view._replace(features=view.features.at[0].set(7.0))
    results = [
        rewarder.update(state, params, seen, expert, jax.random.key(2))[0].params
        for seen in (view, rest, first)
    ]
    jax.tree.map(np.testing.assert_array_equal, results[0], results[1])
    with pytest.raises(AssertionError):
        jax.tree.map(np.testing.assert_array_equal, results[0], results[2])


def test_rejects_another_number_of_expert_samples():
    rewarder, params = make_rewarder(), make_params(0)
    state = rewarder.init(jax.random.key(0), SPEC, params)
    view = make_view(params, random_frames(0, BATCH))
    expert = ExpertBatch(random_frames(1, 4), random_actions(1, 4))
    with pytest.raises(AssertionError):
        rewarder.update(state, params, view, expert, jax.random.key(2))


def test_expert_observations_are_shifted_as_the_agents_are():
    # A picture whose border differs from its middle: shifts change its features.
    params = make_params(0)
    frames = random_frames(1, 1).repeat(BATCH, axis=0)
    view = make_view(params, random_frames(0, BATCH))
    expert = ExpertBatch(frames, random_actions(1, BATCH))
    logits = []
    for padding in (0, 4):
        rewarder = make_rewarder(shift_padding=padding)
        state = rewarder.init(jax.random.key(0), SPEC, params)
        logits.append(
            [
                rewarder.update(state, params, view, expert, jax.random.key(seed))[1][
                    "discriminator/expert_logit"
                ]
                for seed in range(3)
            ]
        )
    np.testing.assert_array_equal(logits[0], logits[0][0])
    assert len(set(map(float, logits[1]))) == 3
