"""The interface of a reader.

A reader is a module with two functions. `recognises(path)` decides by content whether
it can read a file; it never raises. `read(path, options)` yields a `Recording` without
episodes, and then each `PixelEpisode`, with None in between as a heartbeat during long
episodes. It raises FormatError if the file breaks its format's rules. Only regular
files are opened.
"""

import contextlib
import json
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxil.errors import printable
from jaxil.files.untrusted import open_regular, require_regular


class FormatError(ValueError):
    """A file breaks its format's rules.

    The text continues a sentence that begins with the file's name. Text quoted from the
    file is made printable.
    """

    def __init__(self, text: object) -> None:
        super().__init__(printable(text))


class ReadOptions(NamedTuple):
    """The caller's options. Videos and pictures are scaled as they are read."""

    max_bytes: int  # limit of an episode's frames and of any other array
    frame_skip: int = 1  # keeps every n-th frame; videos skip as they are read
    image_size: int | None = None  # height and width; None keeps the file's
    keep_aspect: bool = False  # only shrinks, until the shorter side is `image_size`
    fit: str = "stretch"  # stretch, crop or pad: how other shapes become squares
    camera: str = ""  # of a dataset with several

    def check_bytes(self, name: str, num_bytes: int, way_out: str = "") -> None:
        """Raises FormatError for more than `max_bytes`."""
        if num_bytes > self.max_bytes:
            limit = f"more than the {self.max_bytes} allowed{way_out}"
            raise FormatError(f"has {name} of {num_bytes} bytes, {limit}")


class PixelEpisode(NamedTuple):
    """One episode, frames not stacked; None where the file lacks something."""

    frames: np.ndarray  # uint8 [N + 1, H, W, 3], N >= 1
    actions: np.ndarray | None = None  # action t follows frame t. float32 [N, A]
    rewards: np.ndarray | None = None  # reward t precedes frame t + 1. float32 [N]
    stored_size: tuple[int, int] | None = None  # in the file, if frames were scaled


class Recording(NamedTuple):
    """An opened file: its metadata, None if unknown, and its episodes."""

    kind: str  # name of the format
    num_episodes: int  # at least 1
    episodes: Iterator[PixelEpisode] = iter(())  # read one at a time, may be damaged
    task: str | None = None  # `domain_task`
    action_repeat: int | None = None  # environment frames per stored step
    frames_per_second: float | None = None  # of the stored frames
    origin: str | None = None  # where it comes from, in words
    notes: tuple[str, ...] = ()  # warnings for the user, as whole sentences


Item = Any  # what a reader yields: a Recording, then PixelEpisodes and None
Read = Callable[[pathlib.Path, ReadOptions], Iterator[Item]]


def checked(items: Iterator[Item]) -> Iterator[Item]:
    """Applies `checked_episode` to all episodes of a reader."""
    index = 0
    for item in items:
        if isinstance(item, PixelEpisode):
            item = checked_episode(index, item)
            index += 1
        yield item


def checked_episode(index: int, episode: PixelEpisode) -> PixelEpisode:
    """Checks an episode and converts its numbers to float32; rewards may be [N, 1]."""
    frames, actions, rewards, _ = episode
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise FormatError(
            f"has frames of type {frames.dtype} and shape {frames.shape} in episode "
            f"{index}, but uint8 [N + 1, H, W, 3] is expected"
        )
    if len(frames) < 2 or 0 in frames.shape:
        raise FormatError(
            f"has {len(frames)} frames of {frames.shape[2]}x{frames.shape[1]} pixels "
            f"in episode {index}, but at least two of one pixel are needed"
        )
    if rewards is not None and rewards.shape[1:] == (1,):
        rewards = rewards[:, 0]
    numbers = {"actions": actions, "rewards": rewards}
    for (name, values), axes in zip(numbers.items(), (2, 1), strict=True):
        if values is None:
            continue
        is_number = values.dtype.kind in "biuf"
        if not is_number or values.ndim != axes or len(values) != len(frames) - 1:
            raise FormatError(
                f"has {name} of type {values.dtype} and shape {values.shape} in "
                f"episode {index}, but numbers of {len(frames) - 1} steps on {axes} "
                "axes are expected"
            )
        with np.errstate(all="ignore"):  # numbers too large become infinite
            values = values.astype(np.float32, copy=False)
        if not np.isfinite(values).all():
            raise FormatError(f"has {name} in episode {index} that are not finite")
        numbers[name] = values
    return episode._replace(**numbers)


def ignored(files: Sequence[pathlib.Path]) -> str:
    """Returns a note on files of a folder that are not read."""
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return f"{files[0].name}{more} in its folder: not read."


@contextlib.contextmanager
def naming(file: pathlib.Path, source: pathlib.Path) -> Iterator[None]:
    """Adds the file's name to errors if `source` is its folder."""
    try:
        yield
    except ValueError as error:
        what = error if file == source else f"holds {file.name}, which {error}"
        raise FormatError(what) from error


def read_json(path: pathlib.Path, *, max_bytes: int = 64 * 1024**2) -> dict[str, Any]:
    """Returns the object in a JSON file of a dataset, or raises FormatError."""
    with naming(path, path.parent):
        require_regular(path)
        if path.stat().st_size > max_bytes:
            raise ValueError(f"has more than the {max_bytes} bytes allowed")
        try:
            values = json.loads(path.read_bytes())
        except (ValueError, RecursionError) as error:
            raise ValueError(f"is not JSON ({error})") from error
        if not isinstance(values, dict):
            raise ValueError("is not a JSON object")
        return values


def first_bytes(path: pathlib.Path, count: int) -> bytes:
    """Returns the start of a file; b"" if it is not a readable regular file."""
    try:
        with open_regular(path) as file:
            return file.read(count)
    except OSError:
        return b""
