"""How good a policy is by the task's own reward."""

from collections.abc import Callable
from typing import Any, NamedTuple, overload

import numpy as np

from jaxil.environments.interaction import (
    Act,
    Decision,
    FinishedEpisode,
    interact,
    join,
)


class Evaluation(NamedTuple):
    """Episodes of one policy.

    Attributes:
      episodes: E of them.
      task_returns: undiscounted sums of the task's reward. Shape [E].
      video: images of the first episode, uint8 [T + 1, H, W, 3]; None if not asked for.
    """

    episodes: list[FinishedEpisode]
    task_returns: np.ndarray
    video: np.ndarray | None

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.task_returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over episodes."""
        return float(np.std(self.task_returns))


@overload
def evaluate(
    environment: Any,
    act: Act,
    *,
    num_episodes: int,
    first_episode: int,
    record_video: bool = False,
) -> Evaluation: ...
@overload
def evaluate(
    environment: Any,
    act: Act,
    *,
    num_episodes: int,
    first_episode: int,
    record_video: bool = False,
    stop_asked: Callable[[], bool],
) -> Evaluation | None: ...
def evaluate(
    environment: Any,
    act: Act,
    *,
    num_episodes: int,
    first_episode: int,
    record_video: bool = False,
    stop_asked: Callable[[], bool] = lambda: False,
) -> Evaluation | None:
    """Plays whole episodes without learning.

    Args:
      environment: an `Environment` that nothing else uses, with `frame()` for videos.
      act: the policy; deterministic for the numbers that are reported.
      num_episodes: at least 1.
      first_episode: number of the first, which fixes how each one starts.
      record_video: whether to keep the first episode's images.
      stop_asked: asked after each decision; True ends the evaluation.

    Returns:
      The evaluation; None if it was stopped.
    """
    episodes: list[FinishedEpisode] = []
    returns: list[float] = []
    played: list[Decision] = []
    images: list[np.ndarray] = []
    if record_video:
        # The reset's own image, before the first decision replaces it.
        environment.reset(episode=first_episode)
        images.append(environment.frame())
    for decision in interact(environment, act, first_episode=first_episode):
        played.append(decision)
        if record_video and not episodes:
            images.append(environment.frame())
        if decision.is_last:
            episodes.append(join(played))
            # In double precision, as rewards come, whatever an episode stores.
            returns.append(sum(each.task_reward for each in played))
            played = []
            if len(episodes) == num_episodes:
                break
        if stop_asked():
            return None
    video = np.stack(images) if record_video else None
    return Evaluation(episodes, np.asarray(returns), video)
