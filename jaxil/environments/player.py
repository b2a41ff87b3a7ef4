"""Episodes in one or several environments, which step while the learner learns."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from jaxil.errors import told_as
from jaxil.maths.types import Episode


class Moment(NamedTuple):
    """The result of a reset or a step."""

    observation: np.ndarray  # the policy's input: uint8 [H, W, C] or float32 [S]
    frame: np.ndarray  # the newest, for the replay: uint8 [H, W, 3] or float32 [S]
    task_reward: float  # sum over the action repeat; 0 at a reset
    discount: float  # product over the action repeat; 1 at a reset or time limit
    is_last: bool


class Environments(Protocol):
    """One environment or several, whose steps `receive` waits for."""

    size: int  # how many there are

    def reset(self, index: int, episode: int) -> None:
        """Starts an episode in one environment."""

    def step(self, index: int, action: np.ndarray) -> None:
        """Sends it an action, shape [A]."""

    def receive(self, index: int) -> Moment | None:
        """Waits for the result; None if the environment and its episode are lost."""
        ...

    def close(self) -> None:
        """Closes them and ends their processes."""


class InProcess:
    """A `PixelEnvironment` in this process, as `Environments`: steps in `receive`."""

    size = 1

    def __init__(self, environment: Any) -> None:
        self._environment = environment
        self._request: Callable[[], Any] = lambda: None

    def reset(self, index: int, episode: int) -> None:
        del index
        self._request = lambda: self._environment.reset(episode=episode)

    def step(self, index: int, action: np.ndarray) -> None:
        del index
        self._request = lambda: self._environment.step(action)

    def receive(self, index: int) -> Moment:
        del index
        timestep = self._request()
        return Moment(
            observation=timestep.observation,
            frame=self._environment.single_observation(),
            task_reward=float(timestep.reward or 0.0),
            discount=1.0 if timestep.discount is None else float(timestep.discount),
            is_last=timestep.last(),
        )

    def close(self) -> None:
        self._environment.close()


@dataclasses.dataclass
class _Open:
    """An episode that has begun and not ended."""

    number: int
    repeated: np.ndarray  # actions of an earlier process, with which it begins
    observation: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    is_last: bool = False
    frames: list[np.ndarray] = dataclasses.field(default_factory=list)
    actions: list[np.ndarray] = dataclasses.field(default_factory=list)
    rewards: list[float] = dataclasses.field(default_factory=list)
    discounts: list[float] = dataclasses.field(default_factory=list)

    def add(self, moment: Moment) -> None:
        self.observation, self.is_last = moment.observation, moment.is_last
        if self.frames:  # the first moment is that of a reset
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
    """Plays episodes: `begin`, `step`, then `observe`, again and again.

    Episode i starts from the state that `reset(episode=i)` gives, whichever
    environment plays it. A lost environment's episode is played again from its start.
    """

    def __init__(
        self,
        environments: Environments,
        *,
        first_episode: int,
        open_episodes: Mapping[int, np.ndarray] | None = None,
    ) -> None:
        """Starts nothing yet.

        Args:
          environments: at least one.
          first_episode: number of the first episode that has not begun.
          open_episodes: by number, the actions [t, A] of episodes that an earlier
            process has begun. They are repeated, and the episodes go on from there.
        """
        self._environments = environments
        self.next_episode = first_episode  # the first that has not begun
        self._waiting = dict(open_episodes or {})  # to be begun first
        self._open: dict[int, _Open] = {}  # by environment

    def begin(self, wanted: Callable[[], bool]) -> bool:
        """Starts an episode in each free environment; returns whether any began.

        `wanted` is asked before each new episode whether to play another. Raises the
        errors of `observe`.
        """
        begun = []
        for index in range(self._environments.size):
            if index in self._open:
                continue
            number = min(self._waiting, default=self.next_episode)
            if number not in self._waiting and not wanted():
                break
            if number == self.next_episode:
                self.next_episode += 1
            self._environments.reset(index, number)
            self._open[index] = _Open(number, self._waiting.pop(number, np.zeros(0)))
            begun.append(index)
        for index in begun:
            actions = self._open[index].repeated
            self._receive(index)
            for action in actions:
                if index in self._open:
                    self._step(index, action)
                    self._receive(index)
                if index in self._open and self._open[index].is_last:
                    # Sooner than when it was first played: its task cannot be seeded.
                    self._begin_anew(index)
        if begun and not self._open:  # all are to begin anew
            return self.begin(wanted)
        return bool(begun)

    @property
    def observations(self) -> np.ndarray:
        """The open episodes' observations, in the order of their numbers: [E, ...]."""
        return np.stack([self._open[index].observation for index in self._order()])

    @property
    def is_playing(self) -> bool:
        """Whether any episode is open, or is to be played again."""
        return bool(self._open or self._waiting)

    @property
    def open_episodes(self) -> dict[int, np.ndarray]:
        """The actions [t, A] of each open episode by its number."""
        waiting = {n: np.array(actions) for n, actions in self._waiting.items()}
        return waiting | {e.number: np.array(e.actions) for e in self._open.values()}

    def steps_left(self, episode_steps: int) -> int:
        """Returns the steps left in the open episodes, if all have this length."""
        played = [max(len(e.actions), len(e.repeated)) for e in self._open.values()]
        return sum(max(episode_steps - steps, 0) for steps in played)

    def step(self, actions: np.ndarray) -> None:
        """Sends actions [E, A], in the order of `observations`; does not wait."""
        for index, action in zip(self._order(), actions, strict=True):
            self._step(index, action)

    def observe(self) -> list[Episode]:
        """Waits for the results; returns the episodes that ended, ordered by number.

        Raises EnvironmentsFailed for an error of the task, or if its process keeps
        dying.
        """
        finished = []
        for index in self._order():
            self._receive(index)
            if index in self._open and self._open[index].is_last:
                finished.append(self._open.pop(index).finished())
        return finished

    def close(self) -> None:
        self._environments.close()

    def _order(self) -> list[int]:
        return sorted(self._open, key=lambda index: self._open[index].number)

    def _step(self, index: int, action: np.ndarray) -> None:
        action = np.asarray(action, np.float32)
        self._open[index].actions.append(action)
        self._environments.step(index, action)

    def _receive(self, index: int) -> None:
        with told_as("the task", "a step" if self._open[index].frames else "a reset"):
            moment = self._environments.receive(index)
        if moment is None:  # lost, and the episode with it
            self._begin_anew(index)
        else:
            self._open[index].add(moment)

    def _begin_anew(self, index: int) -> None:
        self._waiting[self._open.pop(index).number] = np.zeros((0, 0))
