"""The rewarders without demonstrations: the task's rewards, and none."""

import jax
import numpy as np
import pytest

from jaxil.rewarders import drqv2, zero
from tests.tiny_agent import NOBODY, make_agent, make_episode, make_spec


@pytest.mark.parametrize(
    ("method", "expected"), [(drqv2, [0.5, -1.0, 2.0]), (zero, [0.0, 0.0, 0.0])]
)
def test_rewards_need_neither_demonstrations_nor_a_state(method, expected):
    rewarder = method.make_rewarder(make_agent())
    spec = make_spec(expert_steps=0, num_demonstrations=0)
    state = rewarder.init(jax.random.key(0), spec, NOBODY)
    assert not jax.tree.leaves(state)
    task_rewards = np.array([0.5, -1.0, 2.0], np.float32)
    episode = make_episode(np.zeros((4, 5)))._replace(rewards=task_rewards)
    assert rewarder.observe(state, NOBODY, episode, None) == state
    rewards = rewarder.rewards(state, NOBODY, episode, None)
    np.testing.assert_array_equal(rewards, expected)
    key = jax.random.key(0)
    assert rewarder.update(state, NOBODY, None, None, key) == (state, {})
    assert not rewarder.expert_batch_size
    assert not rewarder.matches_episodes
    assert rewarder.rewards_changed is None
    assert rewarder.summary(state) == {}
