"""Evaluations: what is kept of the episodes."""

import numpy as np
import pytest

from jaxil.environments.evaluation import evaluate
from tests.environments.counting import Counting


@pytest.mark.parametrize(("num_kept", "expected"), [(1, 1), (2, 2), (9, 4)])
def test_all_episodes_count_but_only_the_first_are_kept(num_kept, expected):
    played = evaluate(
        Counting(3),
        lambda observation: np.zeros(1),
        num_episodes=4,
        first_episode=0,
        num_kept=num_kept,
    )
    assert played.task_returns.shape == (4,)
    assert len(played.episodes) == expected
    for episode, task_return in zip(played.episodes, played.task_returns):
        assert episode.rewards.sum() == task_return
