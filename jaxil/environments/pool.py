"""Several environments side by side, each in a process that is replaced if it fails."""

import contextlib
import multiprocessing
import os
import signal
import socket
import struct
import traceback
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from typing import Any

import numpy as np

from jaxil.environments.interaction import Moment

# A step of the heaviest task takes a second in software; imports and the first image
# take 5 s, on a crowded machine a minute.
_STEP_SECONDS, _START_SECONDS = 60.0, 300.0
_EXIT_SECONDS = 10.0  # that a killed process may take to disappear
_MAX_LOSSES = 3  # in a row, without a whole episode


class EnvironmentsFailed(RuntimeError):
    """Environments cannot continue; the message says why."""


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Lets processes that are started meanwhile ignore Ctrl-C for their whole life.

    A terminal sends it to all processes, and only the parent may act on it.
    """
    resource_tracker.ensure_running()  # where it starts, it would lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Pool:
    """Environments in separate processes, as `interaction.Environments`.

    A process that dies or does not answer is killed and replaced when the next episode
    starts. All of them end with this process, however that ends.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        size: int,
        *,
        say: Callable[[str], None],
        step_seconds: float = _STEP_SECONDS,
        start_seconds: float = _START_SECONDS,
    ) -> None:
        """Starts the processes without waiting for them.

        Args:
          make: makes an `interaction.Environment`. It is pickled by name, and the
            processes import what its module imports.
          size: number of environments.
          say: takes a line for people when a process is replaced.
          step_seconds: that a reset or a step may take.
          start_seconds: the same for the first reset of a process.
        """
        self.size = size
        self._make, self._say = make, say
        self._step_seconds, self._start_seconds = step_seconds, start_seconds
        self._workers: dict[int, _Worker] = {}  # by index
        self._reasons: dict[int, str] = {}  # of the last loss
        self._losses = [0] * size
        try:
            for index in range(size):
                self._workers[index] = _Worker(make)
        except BaseException:
            self.close()
            raise

    @property
    def pids(self) -> list[int]:
        """The numbers of the live processes, by index."""
        return [worker.process.pid or 0 for _, worker in sorted(self._workers.items())]

    def reset(self, index: int, episode: int) -> None:
        """Sends an environment to an episode's start, in a new process if needed."""
        if index not in self._workers:
            self._say(
                f"environment {index} {self._reasons[index]}: a new process replaces "
                f"it and plays episode {episode} from its start"
            )
            self._workers[index] = _Worker(self._make)
        self._workers[index].send(("reset", episode))

    def step(self, index: int, action: np.ndarray) -> None:
        """Sends an environment an action, shape [A]."""
        self._workers[index].send(("step", action))

    def receive(self, index: int) -> Moment | None:
        """Waits for the outcome of a reset or a step; None if the process was lost.

        Raises:
          EnvironmentsFailed: the environment raised an error, or its process was lost
            too many times in a row.
        """
        worker = self._workers[index]
        seconds = self._step_seconds if worker.has_answered else self._start_seconds
        answer = worker.receive(seconds)
        if isinstance(answer, Moment):
            if answer.is_last:
                self._losses[index] = 0
            return answer
        if worker.has_raised:
            raise EnvironmentsFailed(
                f"environment {index} raised an error:\n{answer.rstrip()}"
            )
        self._workers.pop(index).close()
        self._reasons[index] = answer
        self._losses[index] += 1
        if self._losses[index] > _MAX_LOSSES:
            raise EnvironmentsFailed(
                f"environment {index} {answer}; {self._losses[index]} workers in a row "
                "died in mid-episode. Check whether the machine is out of memory; "
                "num_environments=1 needs no workers"
            )
        return None

    def close(self) -> None:
        """Ends all processes."""
        while self._workers:
            self._workers.popitem()[1].close()


class _Worker:
    """One process, as its parent sees it."""

    def __init__(self, make: Callable[[], Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        with socket.socket(fileno=os.dup(self._pipe.fileno())) as ours:
            # A process may also stop in the middle of an answer.
            limit = struct.pack("ll", round(_STEP_SECONDS), 0)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        self.process = context.Process(target=_serve, args=(make, theirs), daemon=True)
        self.has_answered = self.has_raised = False
        with theirs, interrupts_blocked():
            self.process.start()

    def send(self, order: tuple[str, Any]) -> None:
        with contextlib.suppress(ConnectionError):  # `receive` tells
            self._pipe.send(order)

    def receive(self, seconds: float) -> Moment | str:
        """Returns the outcome; or why there is none, as the end of a sentence.

        If `has_raised` is set afterwards, it is the environment's traceback instead.
        """
        try:
            if not self._pipe.poll(seconds):
                return f"did not answer for {seconds:g} s"
            answer = self._pipe.recv()
        except BlockingIOError:
            return "stopped in the middle of an answer"
        except (EOFError, ConnectionError):
            self.process.join(_EXIT_SECONDS)
            code = self.process.exitcode
            if code is not None and code < 0:
                return f"was killed by {signal.Signals(-code).name}"
            return f"ended with status {code}"
        self.has_answered, self.has_raised = True, isinstance(answer, str)
        return answer

    def close(self) -> None:
        """Ends the process at once: it has nothing to save."""
        self.process.kill()
        self.process.join(_EXIT_SECONDS)
        self._pipe.close()


def _serve(make: Callable[[], Any], pipe: Any) -> None:
    """Runs in the worker: obeys until the pipe ends, as it does with the parent."""
    with contextlib.suppress(EOFError, ConnectionError):
        try:
            environment = make()
            while True:
                order, value = pipe.recv()
                if order == "reset":
                    timestep, reward, discount = (
                        environment.reset(episode=value),
                        0.0,
                        1.0,
                    )
                else:
                    timestep = environment.step(value)
                    reward, discount = float(timestep.reward), float(timestep.discount)
                frame = environment.single_observation()
                seen, is_last = timestep.observation, timestep.last()
                pipe.send(Moment(seen, frame, reward, discount, is_last))
        except (EOFError, ConnectionError):
            raise  # the parent is gone
        except Exception:
            pipe.send(traceback.format_exc())
    # At once: GL drivers have been seen to hang while they clean up.
    os._exit(0)
