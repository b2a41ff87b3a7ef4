"""Untrusted files: what may be opened, and how much of it is read."""

import errno
import os
import pathlib
import stat
import zlib
from typing import BinaryIO

_MAX_BYTES = 2**28  # of a file that is read at once
_PIECE_BYTES = 2**20


def open_regular(path: str | os.PathLike) -> BinaryIO:
    """Opens a file for reading; raises OSError for pipes and devices at once."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        number = errno.EISDIR if stat.S_ISDIR(mode) else errno.ENOTSUP
        raise OSError(number, "not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_regular(path: str | os.PathLike, max_bytes: int = _MAX_BYTES) -> bytes:
    """Returns a file's content.

    Raises:
      OSError: it cannot be opened, or is a pipe or device.
      ValueError: it is larger than `max_bytes`.
    """
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > max_bytes:
            raise ValueError(f"{path}: expected at most {max_bytes} bytes")
        return file.read()


def checksum(path: str | os.PathLike) -> int:
    """Returns a file's CRC-32; raises OSError as `open_regular` does."""
    crc = 0
    with open_regular(path) as file:
        while piece := file.read(_PIECE_BYTES):
            crc = zlib.crc32(piece, crc)
    return crc


def require_regular(path: str | os.PathLike, *, or_folder: bool = False) -> None:
    """Rejects pipes, devices and sockets, which could block or never end.

    Raises:
      ValueError: not a regular file; continues a sentence that begins with its name.
    """
    mode = pathlib.Path(path).stat().st_mode
    if not stat.S_ISREG(mode) and not (or_folder and stat.S_ISDIR(mode)):
        kind = "folder" if stat.S_ISDIR(mode) else "pipe, device or socket"
        raise ValueError(f"is a {kind}, not a regular file")
