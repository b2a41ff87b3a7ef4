"""Arrays through a pipe, from a reader in a process of its own to us.

The reader's module is run as a program, which calls `serve`; `open_child` starts it.
Each message is a line of JSON, {"facts": {...}, "arrays": {name: [dtype, shape]}} or
{"fault": "..."}, and then the arrays' bytes.
"""

import contextlib
import json
import math
import os
import pathlib
import resource
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxil.demonstrations.readers.child import Child
from jaxil.demonstrations.readers.recording import FormatError

_CPU_SECONDS = 2.0  # for a tiny file; about half a second of it is for the imports
_BYTES_PER_SECOND = 5e5  # of a file, read on a slow machine, however compressed
_MEMORY_BYTES = 512 * 1024**2  # of the libraries
_MAX_LINE = 10**6
_MAX_FAULT = 500  # letters
_DTYPES = ("uint8", "int64", "float32", "float64")


class Message(NamedTuple):
    """What a reader sends at a time.

    Attributes:
      facts: whatever JSON can say.
      arrays: of the types in `_DTYPES`, by name.
    """

    facts: dict[str, Any]
    arrays: Mapping[str, np.ndarray]


def serve(read: Callable[..., Iterator[Message]]) -> None:
    """Runs a reader as the child: sends its messages, or its fault.

    Args:
      read: called with the path and, by keyword, `max_bytes` and the further arguments
        of `open_child`.
    """
    arguments = json.loads(sys.argv[1])
    output = sys.stdout.buffer
    # Nobody is listening any more.
    with contextlib.suppress(BrokenPipeError):
        try:
            for message in read(pathlib.Path(arguments.pop("path")), **arguments):
                arrays = {
                    name: np.ascontiguousarray(array)
                    for name, array in message.arrays.items()
                }
                kinds = {
                    name: [str(array.dtype), array.shape]
                    for name, array in arrays.items()
                }
                _send_line(output, {"facts": message.facts, "arrays": kinds})
                for array in arrays.values():
                    output.write(array.data.cast("B") if array.size else b"")
                output.flush()
        except FormatError as error:
            _send_line(output, {"fault": str(error)})
        except MemoryError:
            _send_line(output, {"fault": "is damaged: it would fill the memory"})
        except BrokenPipeError:
            raise
        except Exception as error:  # whatever a library thinks of hostile bytes
            text = f"is damaged ({type(error).__name__}: {error})"
            _send_line(output, {"fault": " ".join(text.split())})


def open_no_more_files() -> None:
    """From now on, this process can't open any file, whatever a format refers to."""
    free = os.open(os.devnull, os.O_RDONLY)  # the lowest number that is free
    os.close(free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, free))


def open_child(
    module: str, path: pathlib.Path, *, max_bytes: int, **arguments: Any
) -> Child:
    """Starts a reader on a file.

    Args:
      module: its full name.
      path: the file.
      max_bytes: of any one array.
      **arguments: handed to it; what JSON can say.

    Raises:
      OSError: there is no such file.
    """
    num_bytes = path.stat().st_size
    arguments |= {"path": str(path.absolute()), "max_bytes": max_bytes}
    # Imported from where we are, and from nowhere else.
    folders = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
    environment = {
        "PYTHONPATH": folders,
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "ARROW_DEFAULT_MEMORY_POOL": "system",
        "HDF5_PLUGIN_PRELOAD": "::",  # no plug-ins
    }
    return Child(
        [sys.executable, "-P", "-m", module, json.dumps(arguments)],
        cpu_seconds=_CPU_SECONDS + num_bytes / _BYTES_PER_SECOND,
        memory_bytes=_MEMORY_BYTES + 2 * max_bytes,
        env={**os.environ, **environment},
    )


def receive(child: Child, *, max_bytes: int) -> Message:
    """Returns the next message.

    Raises:
      FormatError: the reader found a fault, died, or sent what it should not.
    """
    line = child.read_line(limit=_MAX_LINE)
    try:
        content = json.loads(line)
        if "fault" in content:
            fault = str(content["fault"])[:_MAX_FAULT]  # may quote the file
            raise FormatError("".join(x if x.isprintable() else "?" for x in fault))
        arrays = {}
        for name, (dtype, shape) in content["arrays"].items():
            if dtype not in _DTYPES or min(shape, default=0) < 0:
                raise ValueError(f"{dtype} {shape}")
            num_bytes = math.prod(shape) * np.dtype(dtype).itemsize
            if num_bytes > max_bytes:
                raise FormatError(
                    f"has {name} of shape {tuple(shape)}, {num_bytes} bytes, more than "
                    f"the {max_bytes} that are accepted"
                )
            array = np.empty(shape, dtype)
            if num_bytes and child.read_into(array.data.cast("B")) < num_bytes:
                raise ValueError(f"{name} is cut off")
            arrays[name] = array
        return Message(dict(content["facts"]), arrays)
    except FormatError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        status = child.finish()
        raise FormatError(
            "is damaged: it broke the program that read it (status "
            f"{status}: {child.said or error})"
        ) from error


def _send_line(output: Any, content: Mapping[str, Any]) -> None:
    output.write(json.dumps(content).encode() + b"\n")
    output.flush()
