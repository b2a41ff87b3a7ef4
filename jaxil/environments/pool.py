"""Several environments side by side, watched over: what dies or hangs is replaced."""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxil.environments.interaction import Moment
from jaxil.environments.worker import Worker, WorkerFailed, WorkerLost

# A step of the heaviest task takes a second in software; imports and the first image
# take 5 s, on a crowded machine a minute.
_STEP_SECONDS, _START_SECONDS = 60.0, 300.0
_MOST_LOSSES = 3  # in a row, without a whole episode


class EnvironmentsFailed(RuntimeError):
    """Environments can't go on; the message says why."""


class Pool:
    """Environments in processes of their own, for `interaction.interact_together`.

    A process that has died or does not answer is killed, and another one takes its
    place when the next episode is to begin there.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        size: int,
        *,
        observation: np.ndarray,
        frame: np.ndarray,
        say: Callable[[str], None],
        step_seconds: float = _STEP_SECONDS,
        start_seconds: float = _START_SECONDS,
    ) -> None:
        """Starts the processes, and does not wait for them.

        Args:
          make: see `worker.Worker`; all are made alike.
          size: how many.
          observation: see `worker.Worker`.
          frame: see there.
          say: takes a line for people, when a process is replaced.
          step_seconds: that a reset or a step may take.
          start_seconds: the same for the first one of a process.
        """
        self.size = size
        self._make, self._observation, self._frame = make, observation, frame
        self._say = say
        self._step_seconds, self._start_seconds = step_seconds, start_seconds
        self._workers: list[Worker | None] = []
        self._has_answered = [False] * size
        self._reasons = [""] * size  # of the last loss
        self._losses = [0] * size
        try:
            for _ in range(size):
                self._workers.append(self._start())
        except BaseException:
            self.close()
            raise

    @property
    def pids(self) -> list[int]:
        """The numbers of the processes that are there."""
        return [worker.pid for worker in self._workers if worker is not None]

    def reset(self, place: int, episode: int) -> None:
        """Sends an environment to the start of an episode, in a new process if needed.

        Args:
          place: of the environment, from 0.
          episode: number of the episode.
        """
        worker = self._workers[place]
        if worker is None:
            self._say(
                f"environment {place} {self._reasons[place]}: a new process takes its "
                f"place and plays episode {episode} from its start"
            )
            self._has_answered[place] = False
            worker = self._workers[place] = self._start()
        worker.reset(episode)

    def step(self, place: int, action: np.ndarray) -> None:
        """Sends an environment an action, shape [A]."""
        self._worker(place).step(action)

    def receive(self, place: int) -> Moment | None:
        """Waits for what came of a reset or a step; None if the process was lost.

        Raises:
          EnvironmentsFailed: the environment raised an error, or its process was lost
            once too often.
        """
        worker = self._worker(place)
        known = self._has_answered[place]
        seconds = self._step_seconds if known else self._start_seconds
        try:
            moment = worker.receive(seconds)
        except WorkerFailed as error:
            raise EnvironmentsFailed(
                f"environment {place} raised an error:\n{str(error).rstrip()}"
            ) from error
        except WorkerLost as error:
            self._lose(place, str(error))
            return None
        self._has_answered[place] = True
        if moment.is_last:
            self._losses[place] = 0
        return moment

    def close(self) -> None:
        """Ends all processes."""
        for place, worker in enumerate(self._workers):
            if worker is not None:
                worker.close()
                self._workers[place] = None

    def _start(self) -> Worker:
        return Worker(self._make, observation=self._observation, frame=self._frame)

    def _worker(self, place: int) -> Worker:
        worker = self._workers[place]
        assert worker is not None, "a lost environment needs a reset"
        return worker

    def _lose(self, place: int, reason: str) -> None:
        self._worker(place).close()
        self._workers[place] = None
        self._reasons[place] = reason
        self._losses[place] += 1
        if self._losses[place] > _MOST_LOSSES:
            raise EnvironmentsFailed(
                f"environment {place} {reason}; it is the process number "
                f"{self._losses[place]} there that plays no episode to its end. See "
                "whether the machine is out of memory; num_environments=1 does without "
                "processes"
            )
