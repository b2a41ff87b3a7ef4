"""An environment in a process of its own: orders by a pipe, frames by shared memory."""

import contextlib
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable
from multiprocessing import resource_tracker
from typing import Any

import numpy as np

from jaxil.environments.interaction import Moment

_BURIAL_SECONDS = 10.0  # until a process that was killed is gone

Shape = tuple[tuple[int, ...], str]  # and the name of the dtype


class WorkerLost(Exception):
    """The process has ended or does not answer; the message says which of them."""


class WorkerFailed(RuntimeError):
    """The environment raised an error; the message is its traceback."""


class Worker:
    """One spawned process, as its parent sees it.

    The process ends when this object's end of the pipe does: also with its parent,
    however that ends.
    """

    def __init__(
        self, make: Callable[[], Any], *, observation: np.ndarray, frame: np.ndarray
    ) -> None:
        """Starts the process, and does not wait for it.

        Args:
          make: makes a `PixelEnvironment`, or what has its `reset(episode)`,
            `step(action)` and `single_observation()`. Pickled by name: what that
            imports, the process imports.
          observation: any; its shape and dtype are those of all observations.
          frame: the same of single observations.
        """
        context = multiprocessing.get_context("spawn")
        shapes = [(array.shape, array.dtype.name) for array in (observation, frame)]
        # It has no name, so that nothing stays behind in /dev/shm.
        memories = [context.RawArray("B", a.nbytes) for a in (observation, frame)]
        self._observation, self._frame = map(_view, memories, shapes)
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(make, theirs, memories, shapes), daemon=True
        )
        # Ctrl-C in a terminal is sent to all processes, and only the parent may heed
        # it. The tracker, where it starts, would lift the block for all.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()

    @property
    def pid(self) -> int:
        """The process's number."""
        assert self._process.pid is not None
        return self._process.pid

    def reset(self, episode: int) -> None:
        """Orders the start of an episode; `receive` has to follow."""
        self._send(("reset", episode))

    def step(self, action: np.ndarray) -> None:
        """Orders a step; `receive` has to follow."""
        self._send(("step", action))

    def receive(self, seconds: float) -> Moment:
        """Waits for what came of the order.

        Args:
          seconds: to wait at most.

        Raises:
          WorkerLost: the process has ended, or does not answer in time.
          WorkerFailed: the environment raised an error.
        """
        try:
            if not self._pipe.poll(seconds):
                raise WorkerLost(f"did not answer for {seconds:g} s")
            answer = self._pipe.recv()
        except (EOFError, ConnectionError) as error:
            raise WorkerLost(self._end()) from error
        if isinstance(answer, str):
            raise WorkerFailed(answer)
        return Moment(self._observation.copy(), self._frame.copy(), *answer)

    def close(self) -> None:
        """Ends the process at once: it has nothing to save."""
        self._process.kill()
        self._process.join(_BURIAL_SECONDS)
        self._pipe.close()

    def _send(self, order: tuple[str, Any]) -> None:
        with contextlib.suppress(ConnectionError):  # `receive` tells
            self._pipe.send(order)

    def _end(self) -> str:
        self._process.join(_BURIAL_SECONDS)
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with status {code}"


def _serve(
    make: Callable[[], Any], pipe: Any, memories: list[Any], shapes: list[Shape]
) -> None:
    """Is the process: obeys until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _obey(make(), pipe, *map(_view, memories, shapes))
    except Exception:
        with contextlib.suppress(ConnectionError):  # the parent may be gone
            pipe.send(traceback.format_exc())
    # At once: GL drivers have been seen to hang while they clean up.
    os._exit(0)


def _obey(
    environment: Any, pipe: Any, observation: np.ndarray, frame: np.ndarray
) -> None:
    while True:
        try:
            order, value = pipe.recv()
        except (EOFError, ConnectionError):
            return
        reward, discount = 0.0, 1.0
        if order == "reset":
            timestep = environment.reset(episode=value)
        else:
            timestep = environment.step(value)
            reward, discount = float(timestep.reward), float(timestep.discount)
        np.copyto(observation, timestep.observation, casting="no")
        np.copyto(frame, environment.single_observation(), casting="no")
        pipe.send((reward, discount, timestep.last()))


def _view(memory: Any, shape: Shape) -> np.ndarray:
    return np.frombuffer(memory, np.dtype(shape[1])).reshape(shape[0])
