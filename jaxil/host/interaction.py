"""The agent and its environment, one decision at a time."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

Act = Callable[[np.ndarray], np.ndarray]  # observation -> action [A]


class Decision(NamedTuple):
    """One agent step.

    Attributes:
      frame: what came of it, not stacked. uint8 [H, W, 3] or float32 [S].
      first_frame: on an episode's first decision, the frame at its reset; else None.
      action: shape [A].
      task_reward: summed over the action repeat.
      discount: product over the action repeat; 1 at a time limit.
      is_last: whether the episode ended with it.
      episode: number of the episode, from 0.
    """

    frame: np.ndarray
    first_frame: np.ndarray | None
    action: np.ndarray
    task_reward: float
    discount: float
    is_last: bool
    episode: int


def interact(
    environment: Any,
    act: Act,
    *,
    first_episode: int,
    meanwhile: Callable[[], None] = lambda: None,
) -> Iterator[Decision]:
    """Yields decisions without end, episode after episode.

    Episode i starts from the state that `environment.reset(episode=i)` gives, so a
    resumed run meets the same starts as an unbroken one.

    Args:
      environment: a `PixelEnvironment`, or anything with its `reset(episode)`,
        `step(action)` and `single_observation()`.
      act: the policy.
      first_episode: number of the first episode.
      meanwhile: called between a decision's action and its step: what it starts on a
        device goes on while the simulator steps and draws.
    """
    episode = first_episode
    while True:
        timestep = environment.reset(episode=episode)
        first_frame = environment.single_observation()
        while not timestep.last():
            action = np.asarray(act(timestep.observation), np.float32)
            meanwhile()
            timestep = environment.step(action)
            yield Decision(
                frame=environment.single_observation(),
                first_frame=first_frame,
                action=action,
                task_reward=float(timestep.reward),
                discount=float(timestep.discount),
                is_last=timestep.last(),
                episode=episode,
            )
            first_frame = None
        episode += 1


class FinishedEpisode(NamedTuple):
    """One whole episode, as the replay takes it.

    Attributes:
      frames: uint8 [T + 1, H, W, 3], or float32 [T + 1, S].
      actions: float32 [T, A].
      task_rewards: float32 [T].
      discounts: float32 [T].
    """

    frames: np.ndarray
    actions: np.ndarray
    task_rewards: np.ndarray
    discounts: np.ndarray


def join(decisions: list[Decision]) -> FinishedEpisode:
    """Returns the episode that `decisions` make up.

    Args:
      decisions: all of one episode, in order.

    Raises:
      ValueError: they do not start at a reset, or do not reach the end.
    """
    first, last = decisions[0], decisions[-1]
    if first.first_frame is None or not last.is_last:
        raise ValueError(
            f"episode {first.episode} is not whole: an episode runs from its reset to "
            "its last decision"
        )
    return FinishedEpisode(
        frames=np.stack([first.first_frame, *(d.frame for d in decisions)]),
        actions=np.stack([d.action for d in decisions]),
        task_rewards=np.asarray([d.task_reward for d in decisions], np.float32),
        discounts=np.asarray([d.discount for d in decisions], np.float32),
    )
