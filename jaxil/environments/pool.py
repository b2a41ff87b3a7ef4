"""Environments in parallel processes, which are replaced if they fail."""

import contextlib
import multiprocessing
import os
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from typing import Any

import numpy as np

from jaxil.environments.player import InProcess, Moment
from jaxil.errors import EnvironmentsFailed, raised

# Rendered in software, the heaviest task takes a second per step; imports and the first
# image take 5 s, or a minute on a busy machine.
_STEP_SECONDS, _START_SECONDS = 60.0, 300.0
_EXIT_SECONDS = 10.0  # for a killed process to disappear
_MAX_LOSSES = 3  # in a row, without a whole episode


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Makes processes that are started in this block ignore Ctrl-C.

    A terminal sends it to all processes, but only the parent may act on it.
    """
    resource_tracker.ensure_running()  # starting it later would lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Pool:
    """Separate processes as `player.Environments`.

    A process that dies or hangs is replaced when the next episode starts. All processes
    end with the parent, even if it is killed.
    """

    def __init__(
        self, make: Callable[[], Any], size: int, *, say: Callable[[str], None]
    ) -> None:
        """Starts `size` processes without waiting for them.

        Args:
          make: makes a `PixelEnvironment`; pickled by name.
          size: number of environments.
          say: receives a message when a process is replaced.
        """
        self.size = size
        self._make, self._say = make, say
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
        return [worker.process.pid or 0 for _, worker in sorted(self._workers.items())]

    def reset(self, index: int, episode: int) -> None:
        """Starts an episode, in a new process if needed."""
        if index not in self._workers:
            self._say(
                f"environment {index} {self._reasons[index]}: a new process restarts "
                f"episode {episode}"
            )
            self._workers[index] = _Worker(self._make)
        self._workers[index].send(("reset", episode))

    def step(self, index: int, action: np.ndarray) -> None:
        self._workers[index].send(("step", action))

    def receive(self, index: int) -> Moment | None:
        """Waits for the result; None if the process was lost.

        Raises EnvironmentsFailed for an error of the environment or repeated losses.
        """
        worker = self._workers[index]
        seconds = _STEP_SECONDS if worker.has_answered else _START_SECONDS
        answer = worker.receive(seconds)
        if isinstance(answer, Moment):
            if answer.is_last:
                self._losses[index] = 0
            return answer
        if worker.has_raised:
            raise EnvironmentsFailed(f"environment {index} raised an error: {answer}")
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
        for worker in self._workers.values():
            worker.dismiss()
        end = time.monotonic() + _EXIT_SECONDS
        while self._workers:
            self._workers.popitem()[1].close(max(end - time.monotonic(), 0.0))


class _Worker:
    """The parent's side of one process."""

    def __init__(self, make: Callable[[], Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        with socket.socket(fileno=os.dup(self._pipe.fileno())) as ours:
            # A process may also hang in the middle of an answer.
            limit = struct.pack("ll", round(_STEP_SECONDS), 0)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        self.process = context.Process(target=_serve, args=(make, theirs), daemon=True)
        self.has_answered = self.has_raised = False
        with theirs, interrupts_blocked():
            self.process.start()

    def send(self, request: tuple[str, Any]) -> None:
        with contextlib.suppress(ConnectionError):  # `receive` reports it
            self._pipe.send(request)

    def receive(self, seconds: float) -> Moment | str:
        """Returns the result, or why there is none: a traceback if `has_raised`."""
        try:
            if not self._pipe.poll(seconds):
                return f"did not answer for {seconds:g} s"
            answer = self._pipe.recv()
        except BlockingIOError:
            return "stopped in the middle of an answer"
        except (EOFError, OSError):  # the latter if it was killed in mid-answer
            self.process.join(_EXIT_SECONDS)
            code = self.process.exitcode
            if code is not None and code < 0:
                return f"was killed by {signal.Signals(-code).name}"
            return f"ended with status {code}"
        self.has_answered, self.has_raised = True, isinstance(answer, str)
        return answer

    def dismiss(self) -> None:
        """Tells the process to close its environment and end, without waiting."""
        self._pipe.close()

    def close(self, seconds: float = 0.0) -> None:
        """Ends the process, which has so long to close its environment."""
        self.dismiss()
        self.process.join(seconds)
        self.process.kill()
        self.process.join(_EXIT_SECONDS)


def _serve(make: Callable[[], Any], pipe: Any) -> None:
    """Runs in the worker until the parent closes the pipe or ends."""
    try:
        environment = InProcess(make())
        for method, value in _requests(pipe):
            getattr(environment, method)(0, value)
            moment = environment.receive(0)
            with contextlib.suppress(ConnectionError):
                pipe.send(moment)
        signal.alarm(round(_EXIT_SECONDS))  # kills a driver that hangs
        environment.close()
    except (Exception, SystemExit) as error:
        with contextlib.suppress(ConnectionError):
            pipe.send(raised(error))
    os._exit(0)  # without further cleanup, in which GL drivers may hang


def _requests(pipe: Any) -> Iterator[tuple[str, Any]]:
    """Yields what the parent asks for until it closes the pipe or ends."""
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            yield pipe.recv()
