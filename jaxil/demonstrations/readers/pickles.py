"""Pickles of ROT and PatchAIL.

The content is a list or tuple [observations, states, actions, rewards], each an array
or list of K episodes, and an episode an array or list of T items:

    observations  uint8 [K, T, 3 n, H, W], n stacked frames, the newest last
    states        anything; ignored
    actions       [K, T, A], action t taken at observation t
    rewards       [K, T], reward t received with observation t; 0 at the reset

The last observation of an episode is not stored. So frames 0 ... T - 1 go with actions
0 ... T - 2 and rewards 1 ... T - 1; the last action and the first reward are dropped.

Source: siddhanthaldar/ROT and sail-sg/PatchAIL, generate.py (order and alignment) and
suite/dmc.py (stacks).
"""

import collections
import pathlib
import pickle
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxil.demonstrations.readers.frames import newest_frames
from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    ReadOptions,
    Recording,
    first_bytes,
)

_MAX_DEPTH = 2  # of lists in an episode: steps, and an action's numbers


def recognises(path: pathlib.Path) -> bool:
    """Returns whether this is any pickle of protocol 2 to 5."""
    return first_bytes(path, 2) in (b"\x80\2", b"\x80\3", b"\x80\4", b"\x80\5")


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads a pickle of arrays and plain containers only."""
    with path.open("rb") as file:
        content = _Unpickler(file, encoding="latin1").load()
    if not isinstance(content, list | tuple) or len(content) != 4:
        raise FormatError("is not a pickle of [observations, states, actions, rewards]")
    columns = {"observations": content[0], "actions": content[2], "rewards": content[3]}
    for name in ("actions", "rewards"):
        if columns[name] is None:
            del columns[name]
    for name, column in columns.items():
        is_array = isinstance(column, np.ndarray) and column.ndim > 0
        if not is_array and not isinstance(column, list | tuple):
            raise FormatError(f"has {name} that are neither array nor list of arrays")
    num_episodes = len(columns["observations"])
    if num_episodes == 0:
        raise FormatError("holds no episode")
    for name, column in columns.items():
        if len(column) != num_episodes:
            what = f"holds {num_episodes} episodes"
            raise FormatError(f"{what}, but {name} of {len(column)}")
    yield Recording(
        kind="ROT or PatchAIL pickle",
        num_episodes=num_episodes,
        notes=("Episodes end one step early: their last observation is not stored.",),
    )
    bytes_left = path.stat().st_size
    for index in range(num_episodes):
        values = {
            name: _numbers(name, column[index], options)
            for name, column in columns.items()
        }
        # A small file can refer to one array very often.
        bytes_left -= values["observations"].nbytes
        if bytes_left < 0:
            raise FormatError("uses one array several times")
        shapes = {name: value.shape for name, value in values.items()}
        if len({shape[:1] for shape in shapes.values()}) > 1:
            raise FormatError(f"has different lengths in episode {index}: {shapes}")
        yield PixelEpisode(
            newest_frames(values["observations"]),
            values["actions"][:-1] if "actions" in values else None,
            values["rewards"][1:] if "rewards" in values else None,
        )


def _numbers(
    name: str, value: Any, options: ReadOptions, depth: int = _MAX_DEPTH
) -> np.ndarray:
    """Returns nested lists of numbers as one array."""
    if isinstance(value, int | float | np.number):
        return np.array(float(value))
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        options.check_bytes(name, value.nbytes)
        return value
    is_list = isinstance(value, list | tuple) or (
        isinstance(value, np.ndarray) and value.dtype == object and value.ndim == 1
    )
    if not is_list or not len(value) or depth == 0:
        raise FormatError(f"has {name} that are neither array nor list of arrays")
    first = _numbers(name, value[0], options, depth - 1)
    options.check_bytes(name, first.nbytes * len(value))
    stacked = np.empty((len(value), *first.shape), first.dtype)
    for index, item in enumerate(value):
        item = _numbers(name, item, options, depth - 1)
        if item.shape != first.shape or item.dtype != first.dtype:
            raise FormatError(f"has {name} of different shapes in one episode")
        stacked[index] = item
    return stacked


def _encode(text: str, encoding: str) -> bytes:
    """Replaces `_codecs.encode`, which would run any registered codec."""
    del encoding
    return text.encode("latin-1")


_ALLOWED: dict[str, Any] = {
    "numpy.ndarray": np.ndarray,
    "numpy.dtype": np.dtype,
    # Their modules depend on the version of NumPy that wrote the file.
    "numpy._reconstruct": np.empty(0).__reduce__()[0],
    "numpy._frombuffer": np.empty(1).__reduce_ex__(5)[0],
    "numpy.scalar": np.float32(0).__reduce__()[0],
    "_codecs.encode": _encode,
    "collections.OrderedDict": collections.OrderedDict,
    "builtins.bytes": bytes,
    "builtins.bytearray": bytearray,
}
_NUMPY_MODULE = re.compile(r"numpy\._?core\.(multiarray|_multiarray_umath|numeric)")


class _Unpickler(pickle.Unpickler):
    """Imports only what arrays and plain containers need."""

    def find_class(self, module: str, name: str) -> Any:
        package = _NUMPY_MODULE.sub("numpy", module).replace("__builtin__", "builtins")
        if f"{package}.{name}" not in _ALLOWED:
            allowed = (
                "only arrays and plain containers are allowed; nothing was executed"
            )
            raise FormatError(f"imports {module}.{name}, but {allowed}")
        return _ALLOWED[f"{package}.{name}"]
