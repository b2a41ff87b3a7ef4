"""The rewarders without demonstrations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.learner.rewarder import AgentView, Spec
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import Episode
from jaxil.rewarders.task import make_task_rewarder, make_zero_rewarder

NOTHING = LearnerParams({}, {}, {})
SPEC = Spec(1, 2, num_demonstrations=0, expert_steps=0, observation_shape=(5,))


@pytest.mark.parametrize(
    ("rewarder", "expected"),
    [(make_task_rewarder(), [0.5, -1.0, 2.0]), (make_zero_rewarder(), [0.0] * 3)],
    ids=["task", "zero"],
)
def test_rewards_need_no_demonstrations(rewarder, expected):
    state = rewarder.init(jax.random.key(0), SPEC, NOTHING)
    assert not jax.tree.leaves(state)
    task_rewards = np.array([0.5, -1.0, 2.0], np.float32)
    episode = Episode(np.zeros((4, 5)), np.zeros((3, 1)), task_rewards)
    rewards, after = rewarder.rewards(state, NOTHING, episode, None)
    np.testing.assert_array_equal(rewards, expected)
    assert after == state
    view = AgentView(*(jnp.zeros((2, n)) for n in (5, 2, 1, 5)))
    assert rewarder.update(state, NOTHING, view, None, jax.random.key(0)) == (state, {})
    assert not rewarder.samples_expert
    assert not rewarder.matches_episodes
    assert rewarder.summary(state) == {}
