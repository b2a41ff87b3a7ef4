"""Plays episodes in one or several environments."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxil.environments.interaction import Environments, Moment
from jaxil.maths.types import Episode


class InProcess:
    """Lets one `Environment` of this process serve as `Environments`."""

    size = 1

    def __init__(self, environment: Any) -> None:
        """Neither owns nor closes the environment."""
        self._environment = environment
        self._request: Callable[[], Any] = lambda: None

    def reset(self, index: int, episode: int) -> None:
        self._request = lambda: self._environment.reset(episode=episode)

    def step(self, index: int, action: np.ndarray) -> None:
        self._request = lambda: self._environment.step(action)

    def receive(self, index: int) -> Moment:
        timestep = self._request()
        return Moment(
            observation=timestep.observation,
            frame=self._environment.single_observation(),
            task_reward=float(timestep.reward or 0.0),
            discount=1.0 if timestep.discount is None else float(timestep.discount),
            is_last=timestep.last(),
        )

    def close(self) -> None:
        """See `Environments`."""


@dataclasses.dataclass
class _OpenEpisode:
    """An unfinished episode."""

    number: int
    observation: np.ndarray | None = None
    is_last: bool = False
    frames: list[np.ndarray] = dataclasses.field(default_factory=list)
    actions: list[np.ndarray] = dataclasses.field(default_factory=list)
    rewards: list[float] = dataclasses.field(default_factory=list)
    discounts: list[float] = dataclasses.field(default_factory=list)

    def add(self, moment: Moment) -> None:
        self.observation, self.is_last = moment.observation, moment.is_last
        if self.frames:  # not at the reset
            self.rewards.append(moment.task_reward)
            self.discounts.append(moment.discount)
        self.frames.append(moment.frame)

    def finished(self) -> Episode:
        return Episode(
            frames=np.stack(self.frames),
            actions=np.stack(self.actions),
            rewards=np.asarray(self.rewards, np.float32),
            discounts=np.asarray(self.discounts, np.float32),
        )


class Player:
    """Plays episodes by repeated calls of `begin`, `step` and `observe`.

    Episode i starts with `reset(episode=i)`, in whichever environment is free. If an
    environment is lost, its episode is restarted.
    """

    def __init__(
        self,
        environments: Environments,
        *,
        first_episode: int,
        open_episodes: Mapping[int, np.ndarray] | None = None,
    ) -> None:
        """Starts no episode yet.

        Args:
          environments: at least one.
          first_episode: number of the first episode that has not begun.
          open_episodes: actions [t, A] by episode number, of episodes to resume: their
            actions are replayed first.
        """
        self._environments = environments
        self._next_episode = first_episode
        self._waiting = dict(open_episodes or {})
        self._open: dict[int, _OpenEpisode] = {}  # by environment

    def begin(self, wanted: Callable[[int], bool]) -> bool:
        """Starts an episode in each free environment; returns whether any began.

        `wanted` decides by number whether to play a new episode.
        """
        begun = []
        for index in range(self._environments.size):
            if index in self._open:
                continue
            number = min(self._waiting, default=self._next_episode)
            if number not in self._waiting and not wanted(number):
                break
            if number == self._next_episode:
                self._next_episode += 1
            self._environments.reset(index, number)
            self._open[index] = _OpenEpisode(number)
            begun.append((index, self._waiting.pop(number, ())))
        for index, actions in begun:
            self._receive(index)
            for action in actions:
                if index in self._open:
                    self._step(index, action)
                    self._receive(index)
        return bool(begun)

    @property
    def observations(self) -> np.ndarray:
        """The open episodes' observations [E, ...], by episode number."""
        shown = [self._open[index].observation for index in self._order()]
        return np.stack([each for each in shown if each is not None])

    @property
    def is_playing(self) -> bool:
        """Whether any episode is open."""
        return bool(self._open)

    @property
    def open_episodes(self) -> dict[int, np.ndarray]:
        """The actions [t, A] of each unfinished episode, by number."""
        found = {e.number: np.array(e.actions) for e in self._open.values()}
        return {**{n: np.array(a) for n, a in self._waiting.items()}, **found}

    def steps_left(self, episode_steps: int) -> int:
        """Returns the agent steps until all open episodes have `episode_steps`."""
        played = [len(episode.actions) for episode in self._open.values()]
        return sum(max(episode_steps - steps, 0) for steps in played)

    def step(self, actions: np.ndarray) -> None:
        """Sends actions [E, A] in the order of `observations`, without waiting."""
        for index, action in zip(self._order(), actions, strict=True):
            self._step(index, action)

    def observe(self) -> list[Episode]:
        """Waits for the results; returns the finished episodes, by number."""
        finished = []
        for index in self._order():
            self._receive(index)
            if index in self._open and self._open[index].is_last:
                finished.append(self._open.pop(index).finished())
        return finished

    def close(self) -> None:
        """Ends the environments' processes."""
        self._environments.close()

    def _order(self) -> list[int]:
        return sorted(self._open, key=lambda index: self._open[index].number)

    def _step(self, index: int, action: np.ndarray) -> None:
        action = np.asarray(action, np.float32)
        self._open[index].actions.append(action)
        self._environments.step(index, action)

    def _receive(self, index: int) -> None:
        moment = self._environments.receive(index)
        if moment is None:  # the environment was lost
            self._waiting[self._open.pop(index).number] = np.zeros((0, 0))
        else:
            self._open[index].add(moment)
