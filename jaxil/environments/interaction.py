"""The agent and its environment, or several of them, one decision at a time."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import dm_env
import numpy as np
from dm_env import specs

Act = Callable[[np.ndarray], np.ndarray]  # observation -> action [A]
ActTogether = Callable[[np.ndarray], np.ndarray]  # observations [E, ...] -> [E, A]


@runtime_checkable
class Environment(Protocol):
    """What the training loop needs of a simulator; time runs in agent steps.

    A `PixelEnvironment` is one; implement these methods to train in another simulator.
    """

    @property
    def episode_steps(self) -> int | None:
        """Agent steps of a whole episode; None where only the task ends it."""
        ...

    def observation_spec(self) -> specs.Array:
        """Returns the spec of observations: uint8 [H, W, C] or float32 [S]."""
        ...

    def action_spec(self) -> specs.BoundedArray:
        """Returns the spec of actions: float32 [A] in [-1, 1]."""
        ...

    def reset(self, episode: int) -> dm_env.TimeStep:
        """Starts an episode, whose number alone fixes its start."""
        ...

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Applies an action; a time limit ends an episode with a discount of 1."""
        ...

    def single_observation(self) -> np.ndarray:
        """Returns the present frame, not stacked: uint8 [H, W, 3] or float32 [S]."""
        ...


class Decision(NamedTuple):
    """One agent step.

    Attributes:
      frame: its outcome, not stacked. uint8 [H, W, 3] or float32 [S].
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

    Args:
      environment: an `Environment`; of it, `reset`, `step` and `single_observation`.
      act: the policy.
      first_episode: number of the first episode.
      meanwhile: called between a decision's action and its step: what it starts on a
        device runs while the simulator steps and renders.
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
                environment.single_observation(),
                first_frame,
                action,
                float(timestep.reward),
                float(timestep.discount),
                timestep.last(),
                episode,
            )
            first_frame = None
        episode += 1


class Moment(NamedTuple):
    """What an environment shows after a reset or a step.

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


def interact_together(
    environments: Any,
    act: ActTogether,
    *,
    first_episode: int,
    begin: Callable[[int], bool],
    meanwhile: Callable[[], None] = lambda: None,
) -> Iterator[list[Decision]]:
    """Yields rounds without end: one decision of each environment that plays.

    Each episode is one that `interact` could have played. A free environment plays the
    lowest number that is left; a lost episode is played again from its start. Rounds
    are sorted by the episodes' numbers, and empty if nothing plays.

    Args:
      environments: a `pool.Pool`, or anything with its `size`, `reset`, `step` and
        `receive`.
      act: the policy; its rows are sorted as the round is.
      first_episode: number of the first episode.
      begin: asked before each episode whether to play it.
      meanwhile: called once for each decision, after the actions are sent and before
        their outcomes are awaited.
    """
    next_episode, lost = first_episode, []
    # What each environment that plays shows: episode, moment, first frame at a reset.
    playing: dict[int, tuple[int, Moment, np.ndarray | None]] = {}
    while True:
        started = {}
        for index in sorted(set(range(environments.size)) - set(playing)):
            episode = min(lost, default=next_episode)
            if not begin(episode):
                break
            if lost:
                lost.remove(episode)
            else:
                next_episode += 1
            environments.reset(index, episode)
            started[index] = episode
        for index, episode in started.items():
            if (moment := environments.receive(index)) is None:
                lost.append(episode)
            else:
                playing[index] = (episode, moment, moment.frame)

        order = sorted(playing, key=lambda index: playing[index][0])
        actions = np.zeros((0, 0), np.float32)
        if order:
            seen = np.stack([playing[index][1].observation for index in order])
            actions = np.asarray(act(seen), np.float32)
        for index, action in zip(order, actions, strict=True):
            environments.step(index, action)
        for _ in order:
            meanwhile()
        decisions = []
        for index, action in zip(order, actions, strict=True):
            episode, _, first_frame = playing.pop(index)
            if (moment := environments.receive(index)) is None:
                lost.append(episode)
                continue
            outcome = moment[2:]
            decisions.append(
                Decision(moment.frame, first_frame, action, *outcome, episode=episode)
            )
            if not moment.is_last:
                playing[index] = (episode, moment, None)
        yield decisions


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
    """Returns the episode that `decisions`, all of one episode in order, make up.

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
