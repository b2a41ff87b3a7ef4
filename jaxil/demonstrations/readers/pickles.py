"""Pickles of pixel demonstrations, as ROT and PatchAIL write them.

The content is a list or tuple [observations, states, actions, rewards], each an array
or a list of K episodes, and an episode an array or a list of T items:

    observations  uint8 [K, T, 3 n, H, W], n stacked frames, the newest last
    states        anything; not read
    actions       [K, T, A], action t taken at observation t
    rewards       [K, T], reward t arrived with observation t; the reset's is 0

The observation that ends an episode is never stored. So frames 0 ... T - 1 have the
actions 0 ... T - 2 and the rewards 1 ... T - 1: the last action, whose outcome is not
shown, and the reset's reward are left out.

Source: siddhanthaldar/ROT and sail-sg/PatchAIL, generate.py (order and alignment) and
suite/dmc.py (stacks).
"""

import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, BinaryIO

import numpy as np

from jaxil.demonstrations.readers.pickle_values import Array
from jaxil.demonstrations.readers.recording import FormatError, PixelEpisode, Recording
from jaxil.demonstrations.readers.stacks import newest_frames, numbers_per_step
from jaxil.demonstrations.readers.unpickling import PROTOCOLS, read_pickle

_MAX_DEPTH = 2  # lists in an episode: of steps, and of an action's numbers


def recognises(path: pathlib.Path) -> bool:
    """Says whether `path` is a pickle, of anything, in one of the protocols 2 to 5."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            start = file.read(2)
    except (OSError, ValueError):
        return False
    return len(start) == 2 and start[0] == 0x80 and start[1] in PROTOCOLS


def open_recording(path: pathlib.Path, *, max_bytes: int) -> Recording:
    """Opens a pickle of demonstrations without executing anything of it.

    Args:
      path: the file.
      max_bytes: the largest array to read.

    Raises:
      FormatError: it is damaged, is a pickle of something else, or needs more than
        arrays, lists and numbers.
      OSError: it can't be opened.
    """
    with path.open("rb") as file:
        content = read_pickle(file)
    if not isinstance(content, list | tuple) or len(content) != 4:
        raise FormatError(
            "is a pickle, but not of a list [observations, states, actions, rewards]"
        )
    columns = {"observations": content[0], "actions": content[2], "rewards": content[3]}
    lengths = {
        name: _length(name, column)
        for name, column in columns.items()
        if column is not None or name == "observations"
    }
    num_episodes = lengths["observations"]
    if num_episodes == 0:
        raise FormatError("holds no episode")
    for name, length in lengths.items():
        if length != num_episodes:
            raise FormatError(f"holds {num_episodes} episodes, but {name} of {length}")
    return Recording(
        kind="ROT or PatchAIL pickle",
        num_episodes=num_episodes,
        episodes=_episodes(path, {name: columns[name] for name in lengths}, max_bytes),
        notes=(
            "Episodes end one step early: their last observation is not in the file.",
        ),
    )


def _episodes(
    path: pathlib.Path, columns: dict[str, Any], max_bytes: int
) -> Iterator[PixelEpisode]:
    with path.open("rb") as file:
        reader = _Reader(file, path.stat().st_size, max_bytes)
        # A column that is one array in another order is read as a whole, once.
        columns = {
            name: reader.numbers(name, column) if _is_mixed(column) else column
            for name, column in columns.items()
        }
        for index in range(_length("observations", columns["observations"])):
            yield _episode(
                index,
                {
                    name: reader.numbers(name, _item(column, index))
                    for name, column in columns.items()
                },
            )


def _episode(index: int, values: dict[str, np.ndarray]) -> PixelEpisode:
    """Puts actions and rewards beside the frames that they belong to."""
    shapes = {name: value.shape for name, value in values.items()}
    lengths = {shape[:1] for shape in shapes.values()}
    if len(lengths) > 1 or min(lengths) < (2,):
        raise FormatError(
            f"has an episode {index} of unequal or too few steps: {shapes}"
        )
    actions = rewards = None
    if "actions" in values:
        actions = numbers_per_step("actions", values["actions"][:-1], 2)
    if "rewards" in values:
        rewards = numbers_per_step("rewards", values["rewards"][1:], 1)
    return PixelEpisode(newest_frames(values["observations"]), actions, rewards)


def _is_mixed(column: Any) -> bool:
    """Whether a column is of numbers whose first axis is not the slowest."""
    return (
        isinstance(column, Array)
        and column.dtype is not None
        and not column.dtype.hasobject
        and not column.has_rows
    )


def _length(name: str, column: Any) -> int:
    if isinstance(column, list | tuple | np.ndarray):
        return len(column)
    if isinstance(column, Array) and column.dtype is not None:
        num_axes = len(column.shape)
        if num_axes == 1 or (num_axes > 1 and not column.dtype.hasobject):
            return column.shape[0]
    raise FormatError(f"has {name} that are no array and no list of arrays")


def _item(column: Any, index: int) -> Any:
    if not isinstance(column, Array):
        return column[index]
    if column.dtype is not None and column.dtype.hasobject:
        return column.data[index]
    return column.row(index)


class _Reader:
    """Reads values from the file, each of its bytes only once.

    A small pickle can name one array very often; without a limit it would fill the
    memory, or an hour.
    """

    def __init__(self, file: BinaryIO, file_bytes: int, max_bytes: int):
        self._file = file
        self._bytes_left = file_bytes
        self._max_bytes = max_bytes

    def numbers(self, name: str, value: Any, depth: int = _MAX_DEPTH) -> np.ndarray:
        """Returns numbers as an array, whatever lists they are in."""
        if isinstance(value, np.ndarray):
            return value
        if isinstance(value, Array) and value.dtype is not None:
            if not value.dtype.hasobject:
                self._spend(value.num_bytes)
                self._check_size(name, value.num_bytes)
                return value.read(self._file)
            value = value.data if len(value.shape) == 1 else None
        if not isinstance(value, list | tuple) or not value or depth == 0:
            raise FormatError(f"has {name} that are no array and no list of arrays")
        self._spend(len(value))
        if all(isinstance(item, int | float) for item in value):
            return self._from_numbers(name, value)
        return self._stacked(name, value, depth)

    def _from_numbers(self, name: str, values: Sequence[float]) -> np.ndarray:
        self._check_size(name, 8 * len(values))
        try:
            return np.array([float(value) for value in values])
        except OverflowError as error:
            raise FormatError(f"has {name} that are too large") from error

    def _stacked(self, name: str, values: Sequence[Any], depth: int) -> np.ndarray:
        bytes_left = self._bytes_left
        first = self.numbers(name, values[0], depth - 1)
        self._check_size(name, first.nbytes * len(values))
        if (bytes_left - self._bytes_left) * len(values) > bytes_left:
            self._spend(bytes_left)
        # Filled one by one, so that never more than one of them exists twice.
        stacked = np.empty((len(values), *first.shape), first.dtype)
        for index, value in enumerate(values):
            item = self.numbers(name, value, depth - 1) if index else first
            if item.shape != first.shape or item.dtype != first.dtype:
                raise FormatError(f"has {name} of different shapes in one episode")
            stacked[index] = item
        return stacked

    def _check_size(self, name: str, num_bytes: int) -> None:
        if num_bytes > self._max_bytes:
            raise FormatError(
                f"has {name} of {num_bytes} bytes in one array, more than the "
                f"{self._max_bytes} that are accepted"
            )

    def _spend(self, num_bytes: int) -> None:
        self._bytes_left -= num_bytes
        if self._bytes_left < 0:
            raise FormatError("uses one array several times")
