"""Untrusted files: what may be opened, and how their text is printed."""

import os
import pathlib
import stat


def require_regular(path: str | os.PathLike, *, or_folder: bool = False) -> None:
    """Rejects pipes, devices and sockets, which could block or never end.

    Raises:
      ValueError: not a regular file; continues a sentence that begins with its name.
    """
    mode = pathlib.Path(path).stat().st_mode
    if not stat.S_ISREG(mode) and not (or_folder and stat.S_ISDIR(mode)):
        kind = "folder" if stat.S_ISDIR(mode) else "pipe, device or socket"
        raise ValueError(f"is a {kind}, not a regular file")


def printable(text: object, max_letters: int = 1000) -> str:
    """Returns text on one line, without control characters and of bounded length."""
    letters = " ".join(str(text)[: 2 * max_letters].split())
    shown = "".join(letter if letter.isprintable() else "?" for letter in letters)
    return shown if len(shown) <= max_letters else f"{shown[: max_letters - 3]}..."
