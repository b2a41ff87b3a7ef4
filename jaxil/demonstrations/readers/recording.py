"""What every reader of foreign files yields, and the rules that it keeps.

A reader is a module with two functions. `recognises(path)` decides by content whether
the format is its own; it never raises. `read(path, options)` yields a `Recording`
without episodes and then each `PixelEpisode` when it is asked for it; on the way to a
long episode it may yield None, to show that it still works. It raises FormatError where
the file breaks its format's rules. Files are opened only if they are regular ones.
"""

import contextlib
import json
import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxil.files.untrusted import printable, require_regular


class FormatError(ValueError):
    """A file is not what it should be.

    Its text is the end of a sentence that begins with the file's name, such as "is cut
    off after 3 of 10 episodes". It may quote the file, whose letters are made harmless.
    """

    def __init__(self, text: object) -> None:
        super().__init__(printable(text))


class ReadOptions(NamedTuple):
    """What a reader needs to know of its caller.

    Attributes:
      max_bytes: of one episode's frames, and of any other array on the way.
      frame_skip: of videos, every n-th frame is kept; other readers ignore it.
      image_size: videos are scaled while they are decoded, to this height and width;
        None leaves them as they are. Other readers ignore it.
      keep_aspect: `image_size` is the shorter side, and nothing is enlarged.
    """

    max_bytes: int
    frame_skip: int = 1
    image_size: int | None = None
    keep_aspect: bool = False

    def check_bytes(self, name: str, num_bytes: int) -> None:
        """Raises FormatError where that is more than `max_bytes`."""
        if num_bytes > self.max_bytes:
            raise FormatError(
                f"has {name} of {num_bytes} bytes, more than the {self.max_bytes} that "
                "are accepted"
            )


class PixelEpisode(NamedTuple):
    """One episode as a file holds it, frames not stacked.

    Attributes:
      frames: uint8 [N + 1, H, W, 3], N >= 1; of any size.
      actions: what was done after frame t, float32 [N, A]; None where the file has
        none.
      rewards: what arrived with frame t + 1, float32 [N]; None where the file has none.
      stored_size: height and width in the file, where they were others.
    """

    frames: np.ndarray
    actions: np.ndarray | None = None
    rewards: np.ndarray | None = None
    stored_size: tuple[int, int] | None = None


class Recording(NamedTuple):
    """An opened file: what it says of itself, and its episodes.

    Attributes:
      kind: the format's name, for people.
      num_episodes: at least 1.
      episodes: yields them in order, reading each when it is asked for, so that memory
        holds one at a time; raises FormatError where one is damaged.
      task: `domain_task`; None where the file does not say.
      action_repeat: environment frames per stored step; None where it does not say.
      frames_per_second: of the stored frames; None where it does not say.
      notes: what a user should know before trusting the data, as whole sentences.
    """

    kind: str
    num_episodes: int
    episodes: Iterator[PixelEpisode] = iter(())
    task: str | None = None
    action_repeat: int | None = None
    frames_per_second: float | None = None
    notes: tuple[str, ...] = ()


Item = Any  # what a reader yields: a Recording, and then each PixelEpisode, or None


def checked(items: Iterator[Item]) -> Iterator[Item]:
    """Yields what a reader yields, its episodes checked and their numbers float32.

    Raises:
      FormatError: an episode has wrong shapes, types or numbers.
    """
    index = 0
    for item in items:
        if isinstance(item, PixelEpisode):
            item = checked_episode(index, item)
            index += 1
        yield item


def checked_episode(index: int, episode: PixelEpisode) -> PixelEpisode:
    """Returns an episode as `PixelEpisode` says; rewards may come as [N, 1]."""
    frames, actions, rewards, _ = episode
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise FormatError(
            f"has frames of type {frames.dtype} and shape {frames.shape} in episode "
            f"{index}, where uint8 [N + 1, H, W, 3] is expected"
        )
    if len(frames) < 2 or 0 in frames.shape:
        raise FormatError(
            f"has {len(frames)} frames of {frames.shape[2]}x{frames.shape[1]} pixels "
            f"in episode {index}, where at least two of one pixel are needed"
        )
    if rewards is not None and rewards.shape[1:] == (1,):
        rewards = rewards[:, 0]
    numbers = {"actions": actions, "rewards": rewards}
    for name, values in numbers.items():
        if values is None:
            continue
        axes = 2 if name == "actions" else 1
        is_number = values.dtype.kind in "biuf"
        if not is_number or values.ndim != axes or len(values) != len(frames) - 1:
            raise FormatError(
                f"has {name} of type {values.dtype} and shape {values.shape} in "
                f"episode {index}, where numbers of {len(frames) - 1} steps on {axes} "
                "axes are expected"
            )
        with np.errstate(all="ignore"):  # a number that is too large becomes infinite
            values = values.astype(np.float32, copy=False)
        if not np.isfinite(values).all():
            raise FormatError(
                f"has {name} in episode {index} that are not finite float32 numbers"
            )
        numbers[name] = values
    return episode._replace(**numbers)


@contextlib.contextmanager
def naming(file: pathlib.Path, source: pathlib.Path) -> Iterator[None]:
    """Where a whole folder is read, names the file that a fault is in."""
    try:
        yield
    except ValueError as error:
        what = error if file == source else f"holds {file.name}, which {error}"
        raise FormatError(what) from error


def read_json(path: pathlib.Path, *, max_bytes: int = 64 * 1024**2) -> dict[str, Any]:
    """Returns the object in a JSON file of a dataset.

    Raises:
      FormatError: it is too long, not JSON, or JSON of something else.
      OSError: it cannot be opened.
    """
    with naming(path, path.parent):
        require_regular(path)
        if path.stat().st_size > max_bytes:
            raise ValueError(f"has more than the {max_bytes} bytes that are accepted")
        try:
            values = json.loads(path.read_bytes())
        except (ValueError, RecursionError) as error:
            raise ValueError(f"is not JSON ({error})") from error
        if not isinstance(values, dict):
            raise ValueError("is not a JSON object")
        return values


def first_bytes(path: pathlib.Path, count: int) -> bytes:
    """Returns how a file begins; b"" where it cannot be opened or is no regular one."""
    try:
        require_regular(path)
        with path.open("rb") as file:
            return file.read(count)
    except (OSError, ValueError):
        return b""
