"""Foreign files of pixels, as episodes of the size that the agent sees."""

import itertools
import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxil.demonstrations.readers import lerobot, minari, own, pickles, replays, videos
from jaxil.demonstrations.readers.frames import resized
from jaxil.demonstrations.readers.recording import (
    FormatError,
    PixelEpisode,
    ReadOptions,
    Recording,
    checked,
)
from jaxil.demonstrations.readers.sandbox import read_in_child
from jaxil.files.untrusted import printable, require_regular

# Asked in this order; each decides by content. Videos last: other datasets hold some.
_READERS: tuple[Any, ...] = (own, pickles, minari, lerobot, replays, videos)
# Parsed in Python, which cannot crash, and checked before anything is unpacked.
_READ_HERE = (own, replays)
FORMATS = (
    "jaxil states or pixels (.npz), ROT or PatchAIL pickles, folders of DrQ-v2 or "
    "V-D4RL episodes (.npz), videos (mp4, mov, gif, webm, mkv, avi), Minari datasets, "
    "LeRobot v3 datasets"
)


class PixelEpisodes(NamedTuple):
    """The episodes of a foreign file, made to fit.

    Attributes:
      recording: the file's facts; its episodes are used up.
      frames: uint8 [K, N + 1, S, S, 3]; a shorter episode repeats its last frame.
      num_frames: how many of them are the episode's own. Shape [K].
      actions: float32 [K, N, A], zero after an episode's end; None without.
      rewards: float32 [K, N], zero after an episode's end; None without.
      stored_size: height and width in the file, of the first episode.
    """

    recording: Recording
    frames: np.ndarray
    num_frames: np.ndarray
    actions: np.ndarray | None
    rewards: np.ndarray | None
    stored_size: tuple[int, int]


def open_recording(
    path: pathlib.Path,
    *,
    max_bytes: int,
    frame_skip: int = 1,
    image_size: int | None = None,
    keep_aspect: bool = False,
) -> Recording:
    """Opens a file or folder of any known format, decided by content.

    Args:
      path: what to open.
      max_bytes: the largest array that may be unpacked.
      frame_skip: every n-th frame is kept, and the rewards between are summed.
      image_size: height and width of the frames; None for those in the file. Videos are
        scaled while they are decoded, so that their size and length need no memory.
      keep_aspect: of videos, `image_size` is the shorter side and nothing is enlarged;
        the frames of other formats are left as they are.

    Returns:
      The recording, whose episodes are checked as they are read.

    Raises:
      FormatError: no reader knows it, or it breaks its format's rules.
      OSError: it cannot be opened.
    """
    try:
        require_regular(path, or_folder=True)
    except ValueError as error:
        raise FormatError(str(error)) from error
    reader = next((reader for reader in _READERS if reader.recognises(path)), None)
    if reader is None:
        raise FormatError(
            f"is cut off, damaged, or in no format that is read: {FORMATS}"
        )
    options = ReadOptions(max_bytes, frame_skip, image_size, keep_aspect)
    if reader in _READ_HERE:
        items = checked(reader.read(path, options))
    else:
        items = read_in_child(reader.read, path, options)
    recording = next(items)
    repeat, speed = recording.action_repeat, recording.frames_per_second
    if reader is videos:  # which skips frames while it decodes them
        frame_skip = 1
    return recording._replace(
        episodes=_fitted(items, frame_skip, None if keep_aspect else image_size),
        task=recording.task and printable(recording.task),
        action_repeat=repeat and repeat * frame_skip,
        frames_per_second=speed and speed / frame_skip,
        notes=tuple(printable(note, 200) for note in recording.notes),
    )


def read_episodes(
    path: pathlib.Path,
    *,
    num_episodes: int,
    image_size: int,
    frame_skip: int,
    max_bytes: int,
) -> PixelEpisodes:
    """Reads the first episodes of a foreign file, resized with antialiasing.

    Args:
      path: file or folder.
      num_episodes: how many.
      image_size: height and width of the result, in pixels.
      frame_skip: every n-th frame is kept.
      max_bytes: the memory that the result, and each array on the way, may take.

    Raises:
      FormatError: see `open_recording`; or it holds fewer episodes, or too much.
      OSError: it cannot be opened.
    """
    recording = open_recording(
        path, max_bytes=max_bytes, frame_skip=frame_skip, image_size=image_size
    )
    if num_episodes > recording.num_episodes:
        raise FormatError(
            f"holds {recording.num_episodes} episodes, and "
            f"num_episodes={num_episodes} were asked for"
        )
    episodes, num_bytes = [], 0
    for episode in itertools.islice(recording.episodes, num_episodes):
        episodes.append(episode)
        num_bytes += episode.frames.nbytes
        if num_bytes > max_bytes:
            raise FormatError(
                f"needs more than {max_bytes} bytes for {len(episodes)} episodes at "
                f"{image_size}x{image_size} pixels, which is more than can be spared"
            )
    if len(episodes) < num_episodes:
        raise FormatError(f"ends after {len(episodes)} of {num_episodes} episodes")
    return PixelEpisodes(
        recording,
        _padded([episode.frames for episode in episodes], repeat_last=True),
        np.array([len(episode.frames) for episode in episodes]),
        _together("actions", [episode.actions for episode in episodes]),
        _together("rewards", [episode.rewards for episode in episodes]),
        episodes[0].stored_size or (image_size, image_size),
    )


def _fitted(
    items: Iterator[PixelEpisode | None], frame_skip: int, image_size: int | None
) -> Iterator[PixelEpisode]:
    """Yields a reader's episodes with frames skipped, and the others resized."""
    for index, episode in enumerate(item for item in items if item is not None):
        frames, actions, rewards, stored_size = episode
        num_steps = (len(frames) - 1) // frame_skip
        if num_steps < 1:
            raise FormatError(
                f"has {len(frames)} frames in episode {index}, too few for "
                f"frame_skip={frame_skip}"
            )
        used = num_steps * frame_skip
        frames = frames[: used + 1 : frame_skip]
        if actions is not None:
            actions = actions[:used:frame_skip]
        if rewards is not None and frame_skip > 1:
            rewards = rewards[:used].reshape(num_steps, frame_skip).sum(axis=1)
        height, width = stored_size or frames.shape[1:3]
        if image_size is not None and frames.shape[1:3] != (image_size, image_size):
            frames = np.stack([resized(x, (image_size, image_size)) for x in frames])
        yield PixelEpisode(frames, actions, rewards, (height, width))


def _together(name: str, values: list[np.ndarray | None]) -> np.ndarray | None:
    """Returns what all episodes have as one array; None where one lacks it."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    shapes = {value.shape[1:] for value in known}
    if len(shapes) > 1:
        raise FormatError(f"has {name} of different shapes: {sorted(shapes)}")
    return _padded(known, repeat_last=False)


def _padded(arrays: list[np.ndarray], *, repeat_last: bool) -> np.ndarray:
    """Stacks arrays [N_k, ...] of different lengths."""
    longest = max(map(len, arrays))
    if all(len(array) == longest for array in arrays):
        return np.stack(arrays)
    stacked = np.zeros((len(arrays), longest, *arrays[0].shape[1:]), arrays[0].dtype)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
        if repeat_last:
            row[len(array) :] = array[-1]
    return stacked
