"""P-DAC on principal components of the frames instead of the critic's features."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.maths.types import ExpertBatch, ExpertEpisodes
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import Discriminator
from jaxil.networks.encoder import StateEncoder
from jaxil.rewarders import codes, pdac
from tests.rewarders.small_pdac import BATCH, STEPS, make_rewarder, make_view
from tests.tiny_agent import (
    make_agent,
    make_episode,
    make_params,
    make_spec,
    random_actions,
    random_frames,
)


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
