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
    video: np.ndarray | None  # of the first episode, uint8 [T + 1, H, W, 3]

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
    record_video: bool = False,
    stop_asked: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Plays whole episodes.

    Args:
      environment: an `Environment` used by nothing else, with `frame()` for videos.
      act: the policy.
      num_episodes: at least 1.
      first_episode: number of the first episode; it determines the initial states.
      record_video: whether to keep the first episode's images.
      stop_asked: called before each agent step; True raises `Stopped`.
    """
    player = Player(InProcess(environment), first_episode=first_episode)
    episodes: list[Episode] = []
    images: list[np.ndarray] = []
    while len(episodes) < num_episodes:
        if stop_asked():
            raise Stopped
        began = player.begin(lambda _: True)
        films = record_video and not episodes
        if films and began:
            images.append(environment.frame())
        player.step(np.asarray(act(player.observations[0]))[None])
        episodes += player.observe()
        if films:
            images.append(environment.frame())
    returns = [episode.rewards.sum(dtype=np.float64) for episode in episodes]
    video = np.stack(images) if record_video else None
    return Evaluation(episodes, np.asarray(returns), video)
