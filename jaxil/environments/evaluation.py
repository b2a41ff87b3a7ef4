"""Evaluates a policy by the task's reward."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxil.environments.player import InProcess, Player
from jaxil.maths.types import Episode

Act = Callable[[np.ndarray], np.ndarray]  # observation -> action [A]


class Evaluation(NamedTuple):
    """E episodes of one policy."""

    episodes: list[Episode]  # the first `num_kept`, with the task's rewards
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
    num_kept: int = 1,
    record: Callable[[], Any] | None = None,
    stop_asked: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Plays whole episodes.

    Args:
      environment: used by nothing else.
      act: the policy.
      num_episodes: at least 1.
      first_episode: number of the first, which determines its initial state.
      num_kept: episodes of which the observations are kept.
      record: called at each moment of the first episode; None records nothing.
      stop_asked: called before each agent step; True raises `Stopped`.
    """
    player = Player(InProcess(environment), first_episode=first_episode)
    kept: list[Episode] = []
    returns: list[float] = []
    recorded: list[Any] = []
    while len(returns) < num_episodes:
        if stop_asked():
            raise Stopped
        began = player.begin(lambda: True)
        records = record if not returns else None
        if records and began:
            recorded.append(records())
        player.step(np.asarray(act(player.observations[0]))[None])
        for episode in player.observe():
            returns.append(episode.rewards.sum(dtype=np.float64))
            kept += [episode] if len(kept) < num_kept else []
        if records:
            recorded.append(records())
    return Evaluation(kept, np.asarray(returns), recorded)
