"""The agent and its environment, one decision at a time, or one of each of several."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

from jaxil.maths.types import Episode

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


class Moment(NamedTuple):
    """What an environment shows after a reset or a step; arrays are the reader's.

    Attributes:
      observation: what the policy sees. uint8 [H, W, C] or float32 [S].
      frame: the present alone, as a replay stores it. uint8 [H, W, 3] or float32 [S].
      task_reward: summed over the action repeat; 0 at a reset.
      discount: product over the action repeat; 1 at a reset.
      is_last: whether the episode is over.
    """

    observation: np.ndarray
    frame: np.ndarray
    task_reward: float
    discount: float
    is_last: bool


class Environments(Protocol):
    """Several environments that work while one waits; see `pool.Pool`."""

    size: int

    def reset(self, place: int, episode: int) -> None:
        """Sends an environment to the start of an episode."""
        ...

    def step(self, place: int, action: np.ndarray) -> None:
        """Sends it an action."""
        ...

    def receive(self, place: int) -> Moment | None:
        """Waits for the outcome; None if it was lost, and the episode with it."""
        ...

    def close(self) -> None:
        """Ends their processes."""
        ...


def join(decisions: list[Decision]) -> Episode:
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
    return Episode(
        frames=np.stack([first.first_frame, *(d.frame for d in decisions)]),
        actions=np.stack([d.action for d in decisions]),
        rewards=np.asarray([d.task_reward for d in decisions], np.float32),
        discounts=np.asarray([d.discount for d in decisions], np.float32),
    )
