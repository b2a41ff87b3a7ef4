"""Episodes of any length are rewarded as they would be without padding."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxil import methods
from jaxil.learner.rewarder import Rewarder
from jaxil.maths.types import Episode
from jaxil.rewarders import zero
from jaxil.training import agent as agents
from jaxil.training import assembly, lengths
from jaxil.training.updates import Updates
from tests.training.drawing import (
    SIDE,
    STEPS,
    Drawing,
    make_agent,
    make_config,
    make_demonstrations,
)

# These compare whole episodes.
_MATCHING = {"psil", "psil_cloning", "sil", "temporal_ot", "orca"}
_CONSTANT = {"zero", "bco", "bcvlr", "laifo"}  # the last one until it has learned
_PLAYING = {name for name, method in methods.known().items() if method.plays}


@given(num_steps=st.integers(1, 3000), longest=st.integers(1, 2000))
def test_there_are_few_lengths_and_little_padding(num_steps, longest):
    padded = lengths.padded_length(num_steps, longest)
    assert num_steps <= padded <= max(num_steps, longest)
    assert padded <= max(8, 1.5 * num_steps)
    assert lengths.padded_length(padded, longest) == padded


def test_a_thousand_lengths_are_few():
    found = sorted({lengths.padded_length(n, 1000) for n in range(1, 1001)})
    assert found[:5] == [8, 12, 16, 24, 32]
    assert found[-2:] == [768, 1000]
    assert len(found) == 15


def draw_episode(num_steps):
    rng = np.random.default_rng(num_steps)
    return Episode(
        frames=rng.integers(0, 255, (num_steps + 1, SIDE, SIDE, 3), dtype=np.uint8),
        actions=rng.uniform(-1, 1, (num_steps, 2)).astype(np.float32),
        rewards=rng.normal(size=num_steps).astype(np.float32),
        discounts=np.ones(num_steps, np.float32),
    )


def first_steps(episode, num_steps):
    frames, *others = episode
    return Episode(frames[: num_steps + 1], *(values[:num_steps] for values in others))


@pytest.mark.parametrize("method", sorted(_PLAYING - _MATCHING))
def test_rewards_of_transitions_do_not_depend_on_what_follows(method):
    agent, episode = make_agent(method), draw_episode(STEPS)
    assert agent.compiled_length(9) == 12
    state = agent.init_state()
    whole = agent.rewards(state.rewarder, state.params, episode, None)
    assert whole.shape == (STEPS,)
    short = first_steps(episode, 9)
    rewards = agent.rewards(state.rewarder, state.params, short, None)
    np.testing.assert_allclose(rewards, whole[:9], rtol=1e-4, atol=1e-6)
    assert np.ptp(whole) > 0 or method in _CONSTANT


def matching_agent(config):
    drawing, demonstrations = Drawing(), make_demonstrations()
    agent = agents.make_agent(config, drawing, demonstrations)  # pyright: ignore
    return agent, agents.expert_episodes(agent.rewarder, demonstrations)


def test_nor_do_rewards_of_components():
    config = make_config("pdac")
    config.discriminator.num_components = 4
    agent, experts = matching_agent(config)
    episode, state = draw_episode(STEPS), agent.init_state()
    rewarder = agent.observe(state.rewarder, state.params, episode, experts)
    whole = agent.rewards(rewarder, state.params, episode, experts)
    short = agent.rewards(rewarder, state.params, first_steps(episode, 9), experts)
    np.testing.assert_allclose(short, whole[:9], rtol=1e-4, atol=1e-6)
    assert np.ptp(whole) > 0


def without_padding(agent, function, state, *arguments):
    """What the method itself returns for an episode as it is."""
    rewarder = getattr(agent.rewarder, function)
    return jax.jit(rewarder)(state.rewarder, state.params, *arguments)


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        *((method, {}) for method in sorted(_MATCHING)),
        ("psil", {"sinkhorn": {"alignment": "time"}}),
        ("psil", {"sinkhorn": {"num_components": 4}}),
    ],
)
def test_comparisons_of_whole_episodes_do_not_see_the_padding(method, settings):
    config = make_config(method, **settings)
    agent, experts = matching_agent(config)
    assert agent.compiled_length(9) == 12
    state, episode = agent.init_state(), draw_episode(9)
    expected = without_padding(agent, "observe", state, episode, experts)
    observed = agent.observe(state.rewarder, state.params, episode, experts)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5),
        observed,
        expected,
    )
    state = state.replace(rewarder=observed)
    rewards = agent.rewards(observed, state.params, episode, experts)
    expected = without_padding(agent, "rewards", state, episode, experts)
    assert rewards.shape == (9,)
    assert np.ptp(rewards) > 0
    np.testing.assert_allclose(rewards, expected, rtol=1e-4, atol=1e-6)
    if agent.rewarder.plan is not None:
        plan, index = agent.plan(observed, state.params, episode, experts)
        expected = without_padding(agent, "plan", state, episode, experts)
        assert plan.shape == (10, STEPS + 1)
        assert index == expected[1]
        np.testing.assert_allclose(plan, expected[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("variant", ["weighted", "bonus"])
def test_the_first_similarity_is_that_of_an_episodes_own_steps(variant):
    config = make_config("patchail")
    config.discriminator.variant = variant
    agent, _ = matching_agent(config)
    state, episode = agent.init_state(), draw_episode(9)
    observed = agent.observe(state.rewarder, state.params, episode, None)
    expected = without_padding(agent, "observe", state, episode, None)
    assert expected.scale > 0
    np.testing.assert_allclose(observed.scale, expected.scale, rtol=1e-5)


def test_a_method_that_does_not_ignore_padding_gets_episodes_as_they_are(monkeypatch):
    def make_rewarder(agent):
        def rewards(state, learner, episode, experts):
            assert isinstance(episode, Episode)
            return jnp.arange(episode.num_steps) / episode.num_steps

        return Rewarder(rewards)

    monkeypatch.setattr(zero, "make_rewarder", make_rewarder)
    (agent, _), episode = matching_agent(make_config("zero")), draw_episode(9)
    assert agent.compiled_length(9) == 9
    state = agent.init_state()
    expected = np.arange(9) / 9
    rewards = agent.rewards(state.rewarder, state.params, episode, None)
    np.testing.assert_allclose(rewards, expected, rtol=1e-6)
    stored = (np.arange(10)[None], episode.actions[None], np.array([9]), None)
    rewards = agent.refresh(state.rewarder, state.params, episode.frames, *stored)
    np.testing.assert_allclose(rewards[0], expected, rtol=1e-6)


@pytest.mark.parametrize("on_device", [False, True])
@pytest.mark.parametrize("method", ["pdac", "psil"])
def test_stored_episodes_of_all_lengths_are_rewarded_anew(method, on_device):
    config = make_config(method, replay_on_device=on_device, replay_size_steps=100)
    (agent, experts), demonstrations = matching_agent(config), make_demonstrations()
    drawing: Any = Drawing()
    replay = assembly.make_replay(config, drawing)
    episodes = [draw_episode(num_steps) for num_steps in (9, 5, 21, 10, 11, 12, 2)]
    for episode in episodes:
        replay.add_episode(**episode._asdict())
    state, before = agent.init_state(), agent.refresh._cache_size()
    observed = agent.observe(state.rewarder, state.params, episodes[0], experts)
    state = state.replace(rewarder=observed)
    checked = []
    updates = Updates(config, agent, replay, demonstrations, experts)
    updates.refresh_rewards(state, checked.append)
    assert np.isfinite([value for each in checked for value in each.values()]).all()
    for number, episode in enumerate(episodes):
        expected = agent.rewards(state.rewarder, state.params, episode, experts)
        stored = replay.rewards(number)
        np.testing.assert_allclose(stored, expected, rtol=1e-4, atol=1e-6)
    assert agent.refresh._cache_size() - before == 3  # of 8, 12 and 21 steps
