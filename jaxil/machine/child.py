"""A generator function that runs in a process of its own, limited in time and memory.

    def echo(prefix):
        request = yield "ready"
        while True:
            request = yield prefix + request

    with Child(echo, "> ") as child:
        child.ask()         # the first request is None, as with `generator.send`
        child.answer()      # "ready"
        child.ask("hello")
        child.answer()      # "> hello"

The process is a fresh interpreter, like those of multiprocessing's "spawn", except that
it does not import the caller's `__main__`: scripts need no `if __name__ == "__main__"`.

Requests are pickled. Answers are not, because the child may be parsing a hostile file:
they are JSON, followed by the raw bytes of NumPy arrays of numbers.
"""

import contextlib
import json
import math
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, Pipe
from typing import Any

import numpy as np

_MAX_TEXT_BYTES = 64 * 1024**2  # of an answer without its arrays
_CHUNK_BYTES = 1024**2
_EXIT_SECONDS = 5.0  # between a child's last byte and its exit status


class ChildError(Exception):
    """The child has no answer.

    `kind` is the class name of what the function raised, or "timeout" or "death".
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(f"{kind}: {text}")
        self.kind, self.text = kind, text


class Child:
    """A process that runs a generator function; to be used in a `with` statement.

    Iterating over it asks for one answer after the other, until the function returns.

    Args:
      function: a generator function at the top level of an importable module.
      *arguments: picklable.
      seconds: longest wait for one answer.
      cpu_seconds: longest computation of one answer.
      memory_bytes: of all data in the process.
      answer_bytes: of all arrays in one answer.
    """

    def __init__(
        self,
        function: Callable[..., Iterator],
        *arguments: Any,
        seconds: float | None = None,
        cpu_seconds: int | None = None,
        memory_bytes: int | None = None,
        answer_bytes: int | None = None,
    ) -> None:
        self._seconds, self._cpu_seconds = seconds, cpu_seconds
        self._answer_bytes = math.inf if answer_bytes is None else answer_bytes
        self.connection, theirs = Pipe()
        folders = [folder or os.getcwd() for folder in sys.path]
        code = f"import sys; sys.path[:] = {folders!r}; from jaxil.machine import child"
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", f"{code}; child.serve({theirs.fileno()})"],
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                process_group=0,  # Ctrl-C is for the parent, which then ends the child
            )
        self.ask((function, arguments, cpu_seconds, memory_bytes))

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_: Any) -> None:
        self.connection.close()
        self._process.kill()
        self._process.wait()

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        self.ask()
        return self.answer()

    def ask(self, request: Any = None) -> None:
        """Sends what the function's `yield` shall return."""
        try:
            self.connection.send(request)
        except OSError as error:
            raise self._death() from error

    def answer(self) -> Any:
        """Returns what the function yields.

        Raises:
          ChildError: it raised an exception or took too long, or the process died.
          StopIteration: it returned.
        """
        if not self.connection.poll(self._seconds):
            raise ChildError("timeout", f"no answer within {self._seconds} s")
        try:
            outcome, kinds, text = json.loads(
                self.connection.recv_bytes(_MAX_TEXT_BYTES)
            )
            arrays = [np.empty(shape, code) for code, shape in kinds]
            is_number = all(array.dtype.kind in "biuf" for array in arrays)
            num_bytes = sum(array.nbytes for array in arrays)
            if not is_number or num_bytes > self._answer_bytes:
                raise ValueError(f"arrays {kinds}")
            for chunk in _chunks(arrays):
                self.connection.recv_bytes_into(chunk)
            value = json.loads(
                text, object_hook=lambda x: arrays[x["array"]] if "array" in x else x
            )
        except Exception as error:  # nothing that a broken child sends is trusted
            raise self._death() from error
        if outcome == "error":
            raise ChildError(*map(str, value))
        if outcome == "end":
            raise StopIteration
        return value

    def _death(self) -> ChildError:
        try:
            status = self._process.wait(_EXIT_SECONDS)
        except subprocess.TimeoutExpired:
            return ChildError("death", "it sent what cannot be understood")
        if status == -signal.SIGXCPU:
            return ChildError("timeout", f"computed for {self._cpu_seconds} s")
        how = signal.Signals(-status).name if status < 0 else f"exit status {status}"
        return ChildError("death", f"it ended with {how}")


def serve(handle: int) -> None:
    """Runs as the child, at the end of the pipe that has this file descriptor."""
    # The parent may close the pipe at any time.
    with (
        contextlib.suppress(EOFError, BrokenPipeError),
        Connection(handle) as connection,
    ):
        function, arguments, cpu_seconds, memory_bytes = connection.recv()
        _limit(resource.RLIMIT_CORE, 0)
        if memory_bytes is not None:
            _limit(resource.RLIMIT_DATA, memory_bytes)
        results = function(*arguments)
        while True:
            request = connection.recv()
            if cpu_seconds is not None:
                used = resource.getrusage(resource.RUSAGE_SELF)
                so_far = math.ceil(used.ru_utime + used.ru_stime)
                _limit(resource.RLIMIT_CPU, so_far + cpu_seconds)
            try:
                answer = "result", results.send(request)
            except StopIteration:
                answer = "end", None
            except BaseException as error:
                answer = "error", [type(error).__name__, str(error)[:10_000]]
            _send(connection, *answer)


def _limit(kind: int, amount: int) -> None:
    _, hard = resource.getrlimit(kind)
    allowed = amount if hard == resource.RLIM_INFINITY else min(amount, hard)
    resource.setrlimit(kind, (allowed, hard))


def _send(connection: Connection, outcome: str, value: Any) -> None:
    arrays = []

    def stand_in(item: Any) -> Any:
        if not isinstance(item, np.ndarray):
            return item.item()  # of a NumPy scalar
        arrays.append(np.asarray(item, order="C"))
        return {"array": len(arrays) - 1}

    text = json.dumps(value, default=stand_in)
    kinds = [(array.dtype.str, array.shape) for array in arrays]
    connection.send_bytes(json.dumps([outcome, kinds, text]).encode())
    for chunk in _chunks(arrays):
        connection.send_bytes(chunk)


def _chunks(arrays: list[np.ndarray]) -> Iterator[memoryview]:
    """Yields views of the arrays' bytes; small, so that no array is ever held twice."""
    for array in arrays:
        content = array.reshape(-1).view(np.uint8).data
        for start in range(0, len(content), _CHUNK_BYTES):
            yield content[start : start + _CHUNK_BYTES]
