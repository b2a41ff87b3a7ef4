"""Lines for people, which never end a run: its terminal or pipe may close."""

import os
import sys
from typing import TextIO


class LastingStream:
    """A text stream that goes quiet, instead of failing, once it is closed.

    So `jaxil.launch ... 2>&1 | head` trains on after `head` has ended.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        """Writes to `stream`; None stands for stderr, whatever that is at the time."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes text out at once."""
        stream = self._stream or sys.stderr
        try:
            stream.write(text)
            stream.flush()
        except (OSError, ValueError, AttributeError):  # closed, or None
            _give_up(stream)
        return len(text)

    def flush(self) -> None:
        """Does nothing: `write` has done it."""

    def isatty(self) -> bool:
        """Returns whether it is a terminal."""
        try:
            return (self._stream or sys.stderr).isatty()
        except (OSError, ValueError, AttributeError):
            return False


def say(text: str) -> None:
    """Writes a line on stderr."""
    LastingStream().write(f"{text}\n")


def _give_up(stream: TextIO | None) -> None:
    """Sends what a stream still holds, and all that others write there, nowhere."""
    try:
        descriptor = stream.fileno()  # pyright: ignore[reportOptionalMemberAccess]
    except (OSError, ValueError, AttributeError):
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
