"""Runs readers in a child process with limits on time and memory.

Parsers written in C may crash or hang on hostile files; the parent then raises
FormatError.
"""

import contextlib
import os
import pathlib
from collections.abc import Iterator
from typing import Any

from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    Read,
    ReadOptions,
    Recording,
    checked,
)
from jaxil.machine import child, memory

_CPU_SECONDS = 20  # per item of a small file
_BYTES_PER_SECOND = 10e6  # read and parsed on a slow machine
_WAIT_FACTOR = 10  # of wall-clock time over CPU time
_MEMORY_BYTES = 1024**3  # for libraries, and a decoder at 3840x2160 pixels
_MEMORY_SHARE = 0.8  # of what is available, so that the child fails and not the machine
_REASONS = {
    "FormatError": "{text}",
    "FileNotFoundError": "has a file that cannot be opened ({text})",
    "timeout": "takes too long to read for its size ({text})",
    "MemoryError": "is damaged: it would fill the memory",
    "death": "is damaged: it crashed the process that read it ({text})",
}


def read_in_child(
    read: Read, path: pathlib.Path, options: ReadOptions
) -> Iterator[Item]:
    """Yields a reader's checked items from a child process.

    Raises:
      FormatError: the file is invalid, or the child timed out or died.
    """
    file_bytes = path.stat().st_size if path.is_file() else 0
    cpu_seconds = _CPU_SECONDS + round(file_bytes / _BYTES_PER_SECOND)
    # A whole pickle is in memory, parts of it twice.
    memory_bytes = _MEMORY_BYTES + 2 * options.max_bytes + 3 * file_bytes
    if available := memory.available_bytes():
        most = int(_MEMORY_SHARE * available)
        memory_bytes = min(memory_bytes, max(most, _MEMORY_BYTES))
    try:
        items = child.results(
            _serve,
            read,
            path.absolute(),
            options,
            seconds=_WAIT_FACTOR * cpu_seconds,
            cpu_seconds=cpu_seconds,
            memory_bytes=memory_bytes,
            result_bytes=2 * options.max_bytes,
        )
        with contextlib.closing(items):
            for content in items:
                kind = Recording if content and "kind" in content else PixelEpisode
                yield content and kind(**content)
    except child.ChildError as error:
        reason = _REASONS.get(error.kind, "is cut off or damaged ({kind}: {text})")
        raise FormatError(reason.format(kind=error.kind, text=error.text)) from error


def _serve(
    read: Read, path: pathlib.Path, options: ReadOptions
) -> Iterator[dict[str, Any] | None]:
    """Runs a reader in the child."""
    os.environ["HDF5_PLUGIN_PRELOAD"] = "::"  # disables plug-ins
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"  # others reserve too much
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # silences libraries
    for item in checked(read(path, options)):
        # Without the iterator of a Recording's episodes, which cannot be sent.
        yield item and {k: v for k, v in item._asdict().items() if k != "episodes"}
