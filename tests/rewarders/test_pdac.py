"""P-DAC: sign, alignment, whose features, and the discriminator's own step."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxil.learner.rewarder import AgentView
from jaxil.maths.types import ExpertBatch, ExpertEpisodes
from jaxil.networks.agent import apply, critic_features
from jaxil.networks.discriminator import Discriminator
from jaxil.networks.encoder import StateEncoder
from jaxil.rewarders import codes, pdac
from tests.tiny_agent import (
    NETWORKS,
    make_agent,
    make_episode,
    make_params,
    make_spec,
    random_actions,
    random_frames,
)

STEPS, BATCH = 5, 8
SPEC = make_spec(expert_steps=4)


@functools.cache
def make_rewarder(frame_stack=1, sees_actions=False, shift_padding=0, num_components=0):
    rewarder = pdac.make_rewarder(
        make_agent(frame_stack, shift_padding),
        hidden_dim=16,
        learning_rate=3e-3,
        gradient_penalty=10.0,
        batch_size=BATCH,
        sees_actions=sees_actions,
        num_components=num_components,
    )
    return rewarder._replace(
        rewards=jax.jit(rewarder.rewards),
        update=jax.jit(rewarder.update),
        observe=jax.jit(rewarder.observe) if num_components else rewarder.observe,
    )


def make_view(params, frames, actions=None):
    features = critic_features(
        NETWORKS, params.encoder, params.critic, jnp.asarray(frames)
    )
    actions = random_actions(9, len(frames)) if actions is None else actions
    frames = jnp.asarray(frames)
    return AgentView(frames, features, jnp.asarray(actions), frames)


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
    features = critic_features(
        NETWORKS, params.encoder, params.critic, jnp.asarray(frames[1:])
    )
    expected = apply(Discriminator(16), state.params, features)
    np.testing.assert_allclose(
        rewards_of(rewarder, params, frames), expected, atol=1e-5
    )


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


# Components instead of features ------------------------------------------------


def experts():
    frames = random_frames(5, 2, 6)
    return ExpertEpisodes(frames, np.asarray([6, 6]), np.zeros((2, 0, 0)))


def judge_of_components(sees_actions=False):
    rewarder = make_rewarder(2, sees_actions, num_components=3)
    params = make_params(0, 2)
    state = rewarder.init(
        jax.random.key(0), make_spec(frame_stack=2, expert_steps=5), params
    )
    play = make_episode(random_frames(6, STEPS + 1))
    return rewarder, params, rewarder.observe(state, params, play, experts())


def test_components_are_judged_whatever_the_agent_has_learned():
    rewarder, params, state = judge_of_components()
    assert rewarder.matches_episodes
    episode = make_episode(random_frames(0, STEPS + 1))
    rewards = rewarder.rewards(state, params, episode, experts())
    code = codes.encode_episode(state.code, episode.frames, frame_stack=2)
    expected = apply(Discriminator(16), state.params, code[1:])
    np.testing.assert_allclose(rewards, expected, atol=1e-5)
    other = rewarder.rewards(state, make_params(1, 2), episode, experts())
    np.testing.assert_array_equal(other, rewards)


def test_components_are_fixed_by_the_first_update():
    rewarder, params, state = judge_of_components()
    play = make_episode(random_frames(7, STEPS + 1))
    again = rewarder.observe(state, params, play, experts())
    assert np.any(again.code.sketch != state.code.sketch)
    stack = jnp.asarray(random_frames(1, BATCH)).repeat(2, axis=-1)
    view = make_view(params, stack)
    expert = ExpertBatch(stack, random_actions(1, BATCH))
    state, metrics = rewarder.update(state, params, view, expert, jax.random.key(2))
    # Agent and expert show the same pixels: nobody can tell them apart.
    np.testing.assert_allclose(
        metrics["discriminator/expert_logit"], metrics["discriminator/agent_logit"]
    )
    later = rewarder.observe(state, params, play, experts())
    jax.tree.map(np.testing.assert_array_equal, later.code, state.code)


@pytest.mark.parametrize("special", [0, 2, STEPS])
def test_with_actions_a_code_and_its_action_are_of_one_moment(special):
    rewarder, params, state = judge_of_components(sees_actions=True)
    episode = make_episode(random_frames(0, STEPS + 1), np.zeros((STEPS, 2)))
    plain = rewarder.rewards(state, params, episode, experts())
    frames = episode.frames.copy()
    frames[special] = random_frames(1, 1)[0]
    changed = rewarder.rewards(
        state, params, episode._replace(frames=frames), experts()
    )
    seen = [t for t in range(STEPS) if special <= t <= special + 1]  # stacked twice
    np.testing.assert_array_equal(np.flatnonzero(np.abs(changed - plain) > 1e-5), seen)


def test_state_vectors_have_no_components():
    agent = make_agent(1)
    agent = agent._replace(networks=agent.networks._replace(encoder=StateEncoder(8)))
    rewarder = pdac.make_rewarder(
        agent,
        hidden_dim=16,
        learning_rate=3e-3,
        gradient_penalty=10.0,
        batch_size=BATCH,
        sees_actions=False,
        num_components=3,
    )
    assert not rewarder.matches_episodes


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
    rewarder, params = make_rewarder(sees_actions=sees_actions), make_params(0)
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
