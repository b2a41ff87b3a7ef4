"""A generator function that runs in a child process, limited in time and memory.

The process is a fresh interpreter, like those of multiprocessing's "spawn", except that
it does not import the caller's `__main__`: scripts need no `if __name__ == "__main__"`.

A hostile file may take over the child, so nothing that it sends is unpickled: results
are JSON, followed by the raw bytes of NumPy arrays of numbers.
"""

import contextlib
import io
import json
import math
import os
import pickle
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from typing import Any

import numpy as np

_MAX_TEXT_BYTES = 64 * 1024**2  # of a result without its arrays
_EXIT_SECONDS = 5.0  # from a child's last byte to its exit status


class ChildError(Exception):
    """The child failed.

    `kind` is the class name of the exception that it raised, or "timeout" or "death".
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(f"{kind}: {text}")
        self.kind, self.text = kind, text


def results(
    function: Callable[..., Iterator],
    *arguments: Any,
    seconds: float,
    cpu_seconds: int,
    memory_bytes: int,
    result_bytes: int,
) -> Generator[Any, None, None]:
    """Yields what a generator function yields in a child process.

    The function is at the top level of a module and its arguments are picklable. Limits
    on wall clock and processor time are per result; `memory_bytes` limits all data of
    the process, `result_bytes` all arrays of a result.

    Raises:
      ChildError: the function raised an error or took too long, or the process died.
    """
    ours, theirs = socket.socketpair()
    folders = [folder or os.getcwd() for folder in sys.path]
    code = f"import sys; sys.path[:] = {folders!r}; from jaxil.machine import child"
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"{code}; child.serve({theirs.fileno()})"],
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            process_group=0,  # Ctrl-C is for the parent, which then ends the child
        )
    try:
        with ours, ours.makefile("rb") as stream:
            work = pickle.dumps((function, arguments, cpu_seconds, memory_bytes))
            ours.settimeout(seconds)
            with contextlib.suppress(OSError):  # it died, which reading reports
                ours.sendall(work)
            ours.settimeout(None)
            while True:
                with _deadline(ours, seconds) as is_late:
                    try:
                        outcome, value = _receive(stream, result_bytes)
                    except Exception as error:  # a broken child may send anything
                        if is_late.is_set():
                            text = f"no result within {seconds} s"
                            raise ChildError("timeout", text) from error
                        raise _death(process, cpu_seconds) from error
                if outcome == "error":
                    raise ChildError(*map(str, value))
                if outcome == "end":
                    return
                yield value
    finally:
        process.kill()
        process.wait()


def serve(handle: int) -> None:
    """Runs in the child, on the socket with this file descriptor."""
    # The parent may close the socket at any time.
    with (
        contextlib.suppress(EOFError, ConnectionError),
        socket.socket(fileno=handle) as connection,
        connection.makefile("rwb") as stream,
    ):
        function, arguments, cpu_seconds, memory_bytes = pickle.load(stream)
        _limit(resource.RLIMIT_CORE, 0)
        _limit(resource.RLIMIT_DATA, memory_bytes)
        items, outcome = function(*arguments), "result"
        while outcome == "result":
            used = resource.getrusage(resource.RUSAGE_SELF)
            used_seconds = math.ceil(used.ru_utime + used.ru_stime)
            _limit(resource.RLIMIT_CPU, used_seconds + cpu_seconds)
            try:
                value = next(items)
            except StopIteration:
                outcome, value = "end", None
            except BaseException as error:
                outcome, value = "error", [type(error).__name__, str(error)[:10_000]]
            _send(stream, outcome, value)


@contextlib.contextmanager
def _deadline(connection: socket.socket, seconds: float) -> Iterator[threading.Event]:
    """Ends reading after `seconds` and then sets the event.

    The socket's own timeout would begin anew with every byte.
    """
    is_late = threading.Event()

    def end() -> None:
        is_late.set()
        with contextlib.suppress(OSError):  # the child may have closed it
            connection.shutdown(socket.SHUT_RD)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    try:
        yield is_late
    finally:
        timer.cancel()
        timer.join()


def _limit(kind: int, amount: int) -> None:
    _, hard = resource.getrlimit(kind)
    allowed = amount if hard == resource.RLIM_INFINITY else min(amount, hard)
    resource.setrlimit(kind, (allowed, hard))


def _death(process: subprocess.Popen, cpu_seconds: int) -> ChildError:
    try:
        status = process.wait(_EXIT_SECONDS)
    except subprocess.TimeoutExpired:
        return ChildError("death", "it sent an invalid result")
    if status == -signal.SIGXCPU:
        return ChildError("timeout", f"computed for {cpu_seconds} s")
    how = signal.Signals(-status).name if status < 0 else f"exit status {status}"
    return ChildError("death", f"it ended with {how}")


def _send(stream: io.BufferedRWPair, outcome: str, value: Any) -> None:
    arrays = []

    def stand_in(item: Any) -> Any:
        if not isinstance(item, np.ndarray):
            return item.item()  # of a NumPy scalar
        arrays.append(np.asarray(item, order="C"))
        return {"array": [item.dtype.str, item.shape]}

    stream.write(json.dumps([outcome, value], default=stand_in).encode() + b"\n")
    stream.flush()
    for array in arrays:
        stream.write(_bytes_of(array))
    stream.flush()


def _receive(stream: io.BufferedReader, room_bytes: int) -> tuple[str, Any]:
    def read_array(item: dict) -> Any:
        nonlocal room_bytes
        if "array" not in item:
            return item
        code, shape = item["array"]
        array = np.empty(shape, code)
        room_bytes -= array.nbytes
        if array.dtype.kind not in "biuf" or room_bytes < 0:
            raise ValueError(f"array {code} {shape}")
        if stream.readinto(_bytes_of(array)) < array.nbytes:
            raise EOFError
        return array

    # The arrays follow the text in the order in which it mentions them.
    return json.loads(stream.readline(_MAX_TEXT_BYTES), object_hook=read_array)


def _bytes_of(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data
