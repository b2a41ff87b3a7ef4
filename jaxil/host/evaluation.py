"""How good a policy is by the task's own reward."""

import itertools
from typing import Any, NamedTuple

import numpy as np

from jaxil.host.interaction import Act, interact


class Evaluation(NamedTuple):
    """Episodes of one policy.

    Attributes:
      task_returns: undiscounted sums of the task's reward. Shape [E].
      video: images of the first episode, uint8 [T + 1, H, W, 3]; None if not asked.
    """

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


def evaluate(
    environment: Any,
    act: Act,
    *,
    num_episodes: int,
    first_episode: int,
    record_video: bool = False,
) -> Evaluation:
    """Plays whole episodes without learning.

    Args:
      environment: one that nothing else uses, with `frame()` for videos.
      act: the policy; deterministic for the numbers that are reported.
      num_episodes: how many, at least 1.
      first_episode: number of the first, which fixes how each one starts.
      record_video: whether to keep the first episode's images.
    """
    returns: list[float] = []
    images: list[np.ndarray] = []
    total = 0.0
    decisions = interact(environment, act, first_episode=first_episode)
    for number in itertools.count():
        if number == 0 and record_video:
            # The reset's own image, before the first decision replaces it.
            environment.reset(episode=first_episode)
            images.append(environment.frame())
        decision = next(decisions)
        total += decision.task_reward
        if record_video and not returns:
            images.append(environment.frame())
        if decision.is_last:
            returns.append(total)
            total = 0.0
            if len(returns) == num_episodes:
                break
    video = np.stack(images) if record_video else None
    return Evaluation(np.asarray(returns), video)
