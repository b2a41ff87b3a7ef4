"""Output to the user that does not end a run if its terminal or pipe closes."""

import os
import sys
from typing import TextIO

from jaxil.errors import printable

_MAX_LETTERS = 4000  # of a line


class LastingStream:
    """A text stream that discards its input, instead of failing, once it is closed.

    With it, `jaxil.launch ... 2>&1 | head` keeps training after `head` has ended.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        """Writes to `stream`, or if None to the current sys.stderr."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes and flushes text."""
        stream = self._stream or sys.stderr
        try:
            try:
                stream.write(text)
            except UnicodeEncodeError:  # such as bars of a sparkline in Latin-1
                name = stream.encoding
                stream.write(text.encode(name, "replace").decode(name))
            stream.flush()
        except (OSError, ValueError, AttributeError):  # closed, or None
            _give_up(stream)
        return len(text)

    def flush(self) -> None:
        """Does nothing, since `write` flushes."""

    def isatty(self) -> bool:
        """Returns whether it is a terminal."""
        try:
            return (self._stream or sys.stderr).isatty()
        except (OSError, ValueError, AttributeError):
            return False


def say(text: str) -> None:
    """Writes lines on stderr, without control characters that a file may contain."""
    lines = [printable(line, _MAX_LETTERS) for line in text.split("\n")]
    LastingStream().write("\n".join([*lines, ""]))


def _give_up(stream: TextIO | None) -> None:
    """Redirects a stream, its buffer included, to /dev/null."""
    try:
        descriptor = stream.fileno()  # pyright: ignore[reportOptionalMemberAccess]
    except (OSError, ValueError, AttributeError):
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
