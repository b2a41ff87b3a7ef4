"""Evaluates a policy by the task's reward."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxil.environments.player import InProcess, Player
from jaxil.maths.types import Episode

Act = Callable[[np.ndarray], np.ndarray]  # observation -> action [A]


class Evaluation(NamedTuple):
    """E episodes of one policy."""

    episodes: list[Episode]  # with the task's rewards
    task_returns: np.ndarray  # undiscounted. Shape [E]
    recorded: list[Any]  # what `record` returned, [T + 1]; else empty

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.task_returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over episodes."""
        return float(np.std(self.task_returns))


class Stopped(Exception):
    """The evaluation was asked to stop."""


def evaluate(
    environment: Any,
    act: Act,
    *,
    num_episodes: int,
    first_episode: int,
    record: Callable[[], Any] | None = None,
    stop_asked: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Plays whole episodes.

    Args:
      environment: used by nothing else.
      act: the policy.
      num_episodes: at least 1.
      first_episode: number of the first episode; it determines the initial states.
      record: called at each moment of the first episode; None records nothing.
      stop_asked: called before each agent step; True raises `Stopped`.
    """
    player = Player(InProcess(environment), first_episode=first_episode)
    episodes: list[Episode] = []
    recorded: list[Any] = []
    while len(episodes) < num_episodes:
        if stop_asked():
            raise Stopped
        began = player.begin(lambda: True)
        records = record if not episodes else None
        if records and began:
            recorded.append(records())
        player.step(np.asarray(act(player.observations[0]))[None])
        episodes += player.observe()
        if records:
            recorded.append(records())
    returns = [episode.rewards.sum(dtype=np.float64) for episode in episodes]
    return Evaluation(episodes, np.asarray(returns), recorded)
