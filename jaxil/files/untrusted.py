"""Other people's files: which ones are opened, and how their text is printed."""

import os
import pathlib
import stat


def require_regular(path: str | os.PathLike, *, or_folder: bool = False) -> None:
    """Raises ValueError for what must not be opened: pipes, devices, sockets.

    Opening one could wait forever or fill the memory.

    Raises:
      ValueError: the end of a sentence that begins with the file's name.
      OSError: there is no such file.
    """
    mode = pathlib.Path(path).stat().st_mode
    if not stat.S_ISREG(mode) and not (or_folder and stat.S_ISDIR(mode)):
        kind = "folder" if stat.S_ISDIR(mode) else "pipe, device or socket"
        raise ValueError(f"is a {kind}, where a regular file is expected")


def printable(text: object, max_letters: int = 1000) -> str:
    """Returns text on one line, without control characters and of bounded length."""
    letters = " ".join(str(text)[: 2 * max_letters].split())
    shown = "".join(letter if letter.isprintable() else "?" for letter in letters)
    return shown if len(shown) <= max_letters else f"{shown[: max_letters - 3]}..."
