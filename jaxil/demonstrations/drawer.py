"""One process that draws stored episodes, with a GL context of its own.

This module is also the program that the process runs, started afresh and not forked:
neither GL nor jax survives a fork. It needs no jax.
"""

import collections
import contextlib
import dataclasses
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from jaxil.environments import suite

# Imports and the GL context take 2 s; on a crowded machine half a minute, most of it in
# Mesa, which looks at each core and waits until that has a moment. A few images of the
# heaviest task take some seconds.
_START_SECONDS = _SILENCE_SECONDS = 60.0
_BURIAL_SECONDS = 10.0  # until a process that was killed is gone
_CHUNK = 8  # images; small, so that a pipe always holds the orders for two of them
_MOST_ORDERS = 2  # the next one is there when a chunk is done

# Takes an episode's place, the time of the first image, and uint8 [n, H, W, 3].
Take = Callable[[int, int, np.ndarray], None]


@dataclasses.dataclass(frozen=True)
class Episode:
    """What is to be drawn.

    Attributes:
      place: among the caller's episodes.
      number: in the environment that recorded it.
      states: `qpos`, `qvel` and `act`, each [N + 1, n].
      start: time of the first of them.
    """

    place: int
    number: int
    states: Mapping[str, np.ndarray]
    start: int = 0

    def __len__(self) -> int:
        """The number of images."""
        return len(self.states["qpos"])

    def part(self, start: int, stop: int) -> "Episode":
        """Returns the moments from one place in `states` to before another."""
        states = {name: array[start:stop] for name, array in self.states.items()}
        return dataclasses.replace(self, states=states, start=self.start + start)


def images(
    environment: Any, number: int, states: Mapping[str, np.ndarray]
) -> Iterator[np.ndarray]:
    """Draws moments of an episode one by one, uint8 [H, W, 3].

    Args:
      environment: a `PixelEnvironment`. It is reset to the episode, which alone tells
        what the states don't hold, unless that was its last reset.
      number: of the episode.
      states: see `Episode`.

    Raises:
      ValueError: the states don't fit the task's model.
      RuntimeError: nothing here can render.
    """
    if environment.num_episodes_started != number + 1:
        environment.reset(episode=number)
    for values in zip(*states.values(), strict=True):
        environment.set_simulator_state(**dict(zip(states, values, strict=True)))
        yield environment.single_observation()


class Lost(Exception):
    """A process is of no more use; the message, which starts with a verb, says why."""


class Drawer:
    """One process, as its parent sees it."""

    def __init__(
        self,
        settings: Mapping[str, Any],
        gl_name: str,
        waiting: collections.deque[Episode],
    ) -> None:
        """Starts the process, and does not wait for it.

        Args:
          settings: arguments of `make_environment`.
          gl_name: what is to draw, see `Renderer.gl_name`.
          waiting: where the process takes its episodes, as others do.

        Raises:
          OSError: the system has no process left.
        """
        self._gl_name = gl_name
        self._waiting = waiting
        self._chunks = _chunks(waiting)
        self._ordered: collections.deque[tuple[int, int]] = collections.deque()
        self._has_started = False
        self._heard_at = time.monotonic()
        ours, theirs = socket.socketpair()
        # A process may also stop in the middle of a message.
        patience = struct.pack("ll", round(_SILENCE_SECONDS), 0)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, patience)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, patience)
        self.pipe = Connection(ours.detach())
        # A program of its own, not a `multiprocessing.Process`: that would run the
        # caller's script once more, and drawing begins inside a plain function call.
        # It is imported from where we are, and from nowhere else.
        folders = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
        environment = {"LP_NUM_THREADS": "0"}  # llvmpipe's own; ours take the cores
        environment |= {**os.environ, "PYTHONPATH": folders}
        descriptor = theirs.fileno()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__, str(descriptor)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # errors come through the pipe
                pass_fds=[descriptor],
                env=environment,
                process_group=0,  # Ctrl-C reaches us and not the process
            )
        with contextlib.suppress(OSError):  # `receive` tells
            self.pipe.send(dict(settings))

    def is_at_work(self) -> bool:
        """Returns whether anything can still come from it."""
        return bool(self._ordered) or (not self._has_started and bool(self._waiting))

    def seconds_left(self) -> float:
        """Returns until when it has to answer, from now."""
        limit = _SILENCE_SECONDS if self._has_started else _START_SECONDS
        return self._heard_at + limit - time.monotonic()

    def receive(self, take: Take) -> None:
        """Takes an answer, which has to be there, and orders more.

        Raises:
          Lost: it has ended, or says that it will.
        """
        try:
            answer = self.pipe.recv()
        except BlockingIOError:
            raise Lost("does not answer") from None
        except (EOFError, OSError):  # an OSError if it died within the message
            raise Lost(self._end()) from None
        self._heard_at = time.monotonic()
        if isinstance(answer, tuple):
            raise Lost(f"raised an error ({answer[0]})")
        if self._has_started:
            take(*self._ordered.popleft(), answer)
        elif answer != self._gl_name:
            raise Lost(f"draws with {answer}, where {self._gl_name} is wanted")
        self._has_started = True
        with contextlib.suppress(OSError):  # the next `receive` tells
            while len(self._ordered) < _MOST_ORDERS:
                chunk = next(self._chunks, None)
                if chunk is None:
                    break
                self._ordered.append((chunk.place, chunk.start))
                self.pipe.send((chunk.number, chunk.states))

    def close(self) -> None:
        """Ends the process at once: it has nothing to save."""
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_BURIAL_SECONDS)
        self.pipe.close()

    def _end(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_BURIAL_SECONDS)
        code = self._process.returncode
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with status {code}"


def _chunks(waiting: collections.deque[Episode]) -> Iterator[Episode]:
    """Takes episodes out of `waiting` and yields them in pieces, in their order."""
    while waiting:
        episode = waiting.popleft()
        for start in range(0, len(episode), _CHUNK):
            yield episode.part(start, start + _CHUNK)


def _serve(descriptor: int) -> None:
    """Is the process: obeys until the pipe ends, as it does with its parent."""
    pipe = Connection(descriptor)
    with contextlib.suppress(EOFError, OSError):
        try:
            environment = suite.make_environment(**pipe.recv())
            pipe.send(environment.renderer.gl_name())
            while True:
                number, states = pipe.recv()
                pipe.send(np.stack(list(images(environment, number, states))))
        except (EOFError, ConnectionError):
            raise  # the parent is gone
        except Exception as error:
            pipe.send((f"{type(error).__name__}: {error}",))
    # At once: GL drivers have been seen to hang while they clean up.
    os._exit(0)


if __name__ == "__main__":
    _serve(int(sys.argv[1]))
