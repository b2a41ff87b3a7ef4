"""Programs that read a stranger's file in our place, bounded in time and memory.

Parsers written in C may crash or never end on hostile bytes. In a process of their own
they end alone, and what they did shows as a FormatError.
"""

import contextlib
import os
import re
import resource
import selectors
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import IO

from jaxil.demonstrations.readers.recording import FormatError

_WAIT_SECONDS = 60.0  # on top of twice its own time: others use the machine, too
_MAX_SAID = 4096  # bytes of complaints that are kept


class Child:
    """A running program, read through its standard output.

    Used in a `with` statement, at the end of which the program no longer runs. The
    clocks stand still while nobody reads.
    """

    def __init__(
        self,
        command: Sequence[str | os.PathLike],
        *,
        cpu_seconds: float,
        memory_bytes: int,
        stdin: IO[bytes] | int = subprocess.DEVNULL,
        env: Mapping[str, str] | None = None,
    ):
        """Starts it.

        Args:
          command: the program and its arguments.
          cpu_seconds: how long it may compute.
          memory_bytes: how much it may fill.
          stdin: what it reads.
          env: its environment variables; None for ours.
        """
        self._cpu_seconds = cpu_seconds
        self._wait_seconds = _WAIT_SECONDS + 2 * cpu_seconds
        # No Python code between fork and exec, which can deadlock where there are
        # threads; a process group so that Ctrl-C reaches us and not the child.
        self._process = subprocess.Popen(
            command,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=env,
            process_group=0,
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._limit(resource.RLIMIT_CPU, max(round(cpu_seconds), 1))
        self._limit(resource.RLIMIT_DATA, memory_bytes)
        self._limit(resource.RLIMIT_CORE, 0)
        self._stdout = self._process.stdout.fileno()
        self._stderr = self._process.stderr.fileno()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._stdout, selectors.EVENT_READ)
        self._selector.register(self._stderr, selectors.EVENT_READ)
        self._read_ahead = bytearray()
        self._is_at_end = False
        self._said = bytearray()

    def __enter__(self) -> "Child":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._selector.close()
        self._process.kill()
        # Closes the pipes and waits.
        self._process.__exit__(kind, error, traceback)

    @property
    def said(self) -> str:
        """The first line that it wrote to standard error, made harmless."""
        line = self._said.decode("ascii", "replace").strip().partition("\n")[0]
        line = re.sub(r" @ 0x[0-9a-f]+", "", line)
        return "".join(letter if letter.isprintable() else "?" for letter in line)[:200]

    def read_line(self, *, limit: int = 1000) -> bytes:
        """Returns the next line without its end; b"" when there are no more.

        Raises:
          FormatError: it is longer than `limit` bytes, or the time is up.
        """
        while (end := self._read_ahead.find(b"\n")) < 0:
            if len(self._read_ahead) > limit:
                raise FormatError(f"is damaged: a line of more than {limit} bytes")
            more = os.read(self._stdout, 65536) if self._wait() else b""
            if not more:
                self._is_at_end = True
                line = bytes(self._read_ahead)
                self._read_ahead.clear()
                return line
            self._read_ahead += more
        line = bytes(self._read_ahead[:end])
        del self._read_ahead[: end + 1]
        return line

    def read_into(self, view: memoryview) -> int:
        """Fills `view`; returns how many bytes came before the end.

        Raises:
          FormatError: the time is up.
        """
        filled = min(len(view), len(self._read_ahead))
        view[:filled] = self._read_ahead[:filled]
        del self._read_ahead[:filled]
        while filled < len(view) and self._wait():
            count = os.readv(self._stdout, [view[filled:]])
            if not count:
                self._is_at_end = True
                break
            filled += count
        return filled

    def finish(self) -> int:
        """Returns the exit status, negative for a signal.

        A program that has not been read to the end of its output is killed.

        Raises:
          FormatError: the time is up.
        """
        if not self._is_at_end:
            self._process.kill()
        with contextlib.suppress(KeyError):
            self._selector.unregister(self._stdout)
        while self._selector.get_map():
            self._wait()
        try:
            status = self._process.wait(self._wait_seconds)
        except subprocess.TimeoutExpired:
            raise self._too_slow() from None
        if status == -signal.SIGXCPU:
            raise self._too_slow()
        return status

    def _wait(self) -> bool:
        """Waits until output can be read; False when only the end is left."""
        while self._selector.get_map():
            start = time.monotonic()
            ready = self._selector.select(max(self._wait_seconds, 0))
            self._wait_seconds -= time.monotonic() - start
            if not ready:
                raise self._too_slow()
            files = [key.fd for key, _ in ready]
            if self._stderr in files:
                said = os.read(self._stderr, 4096)
                if not said:
                    self._selector.unregister(self._stderr)
                self._said += said[: _MAX_SAID - len(self._said)]
            if self._stdout in files:
                return True
            if self._stdout not in self._selector.get_map():
                return False
        return False

    def _too_slow(self) -> FormatError:
        return FormatError(
            f"takes more than {self._cpu_seconds:.0f} s to read, which its size does "
            "not explain: it is damaged"
        )

    def _limit(self, kind: int, amount: int) -> None:
        """Sets a limit of the child, where the system knows how (Linux)."""
        prlimit = getattr(resource, "prlimit", None)
        if prlimit is not None:
            # It may have ended already, or have a lower limit.
            with contextlib.suppress(ProcessLookupError, PermissionError, ValueError):
                prlimit(self._process.pid, kind, (amount, amount + 1))
