"""Evaluations: whose policy is played."""

import types
from typing import Any

import numpy as np
import pytest

from jaxil.config import default_config
from jaxil.learner.state import PolicyParams
from jaxil.training.evaluator import Evaluator
from tests.environments.counting import Counting
from tests.learner.small_learner import make_learner, make_state

EPISODE_STEPS = 3


@pytest.mark.parametrize("averages", [False, True])
def test_the_average_is_played_where_there_is_one(averages):
    played = []

    def mean_action(encoder, actor, observations):
        played.append((encoder, actor))
        return np.zeros((len(observations), 1), np.float32)

    state, other = (make_state(make_learner(), seed) for seed in (0, 1))
    expected = state.newest_policy
    if averages:
        expected = other.newest_policy
        state = state.replace(average=expected)
    config = default_config()
    config.update(num_eval_episodes=2, video_every_evals=0)
    agent: Any = types.SimpleNamespace(mean_action=mean_action)
    environment: Any = Counting(EPISODE_STEPS)
    evaluator = Evaluator(config, agent, environment, None, None)
    result = evaluator.evaluate(
        state, number=0, is_last=False, stop_asked=lambda: False
    )
    assert result is not None
    assert len(played) == 2 * EPISODE_STEPS
    assert all(PolicyParams(*each) == expected for each in played)
