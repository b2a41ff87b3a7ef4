"""P-SIL between principal components of the frames instead of the actor's features."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.networks.encoder import StateEncoder
from jaxil.rewarders import codes, psil
from jaxil.rewarders.matching import make_matching
from tests.tiny_agent import (
    make_agent,
    make_episode,
    make_experts,
    make_params,
    make_spec,
    random_frames,
)

STEPS, EXPERT_STEPS, K, STACK = 6, 5, 3, 2
SPEC = make_spec(num_demonstrations=K, expert_steps=EXPERT_STEPS, frame_stack=STACK)
EXPERTS = make_experts(random_frames(50, K, EXPERT_STEPS + 1))
MATCHING = {
    "cost": "cosine",
    "alignment": "transport",
    "epsilon": 0.01,
    "num_iterations": 50,
}


def make_rewarder(agent=None):
    return psil.make_rewarder(
        agent or make_agent(STACK),
        **MATCHING,
        target_update_steps=20,
        return_scale=10.0,
        num_components=4,
    )


def after_first_episode():
    rewarder, params = make_rewarder(), make_params(0, STACK)
    state = rewarder.init(jax.random.key(0), SPEC, params)
    first = make_episode(random_frames(6, STEPS + 1))
    return rewarder, params, first, rewarder.observe(state, params, first, EXPERTS)


def test_rewards_are_those_of_the_codes():
    rewarder, params, first, state = after_first_episode()
    assert rewarder.matches_episodes
    episode = make_episode(random_frames(0, STEPS + 1))

    def code(frames):
        return codes.encode_episode(state.code, frames, frame_stack=STACK)

    rewards = make_matching(**MATCHING).rewards(
        code(jnp.asarray(episode.frames)),
        jnp.array(STEPS + 1),
        jnp.stack([code(jnp.asarray(frames)) for frames in EXPERTS.frames]),
        EXPERTS.num_frames,
    )
    got = rewarder.rewards(state, params, episode, EXPERTS)
    np.testing.assert_allclose(got, state.scale * rewards[1:], rtol=1e-4)
    total = jnp.sum(rewarder.rewards(state, params, first, EXPERTS))
    np.testing.assert_allclose(total, -10.0, rtol=1e-5)


def test_rewards_stay_whatever_the_agent_learns_or_plays():
    rewarder, params, first, state = after_first_episode()
    before = rewarder.rewards(state, params, first, EXPERTS)
    other = make_episode(random_frames(7, STEPS + 1))
    later = rewarder.observe(state, make_params(1, STACK), other, EXPERTS)
    again = rewarder.rewards(later, make_params(1, STACK), first, EXPERTS)
    np.testing.assert_array_equal(before, again)
    assert rewarder.rewards_changed is None  # so that none is recomputed in vain


def test_a_demonstration_itself_is_the_best_that_an_agent_can_do():
    rewarder, params, _, state = after_first_episode()
    copied = make_episode(np.asarray(EXPERTS.frames[1]))
    random = make_episode(random_frames(8, EXPERT_STEPS + 1))
    best, other = (
        float(jnp.sum(rewarder.rewards(state, params, each, EXPERTS)))
        for each in (copied, random)
    )
    assert -0.1 < best <= 0.0
    assert other < -1.0
    assert rewarder.plan is not None
    _, index = rewarder.plan(state, params, copied, EXPERTS)
    assert int(index) == 1


def test_state_vectors_have_no_components():
    agent = make_agent(1)
    agent = agent._replace(networks=agent.networks._replace(encoder=StateEncoder(8)))
    # Features change as the agent learns, and so do rewards.
    assert make_rewarder(agent).rewards_changed is not None
