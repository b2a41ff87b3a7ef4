"""Reads files of pixels in any supported format, resized for the agent."""

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
from jaxil.errors import printable
from jaxil.files.untrusted import require_regular

# The first that recognises a file reads it. Videos last: datasets may contain some.
_READERS: tuple[Any, ...] = (own, pickles, minari, lerobot, replays, videos)
# Safe without a child process: parsed in Python, and checked before unpacking.
_IN_PROCESS = (own, replays)
FORMATS = (
    "jaxil states or pixels (.npz), ROT or PatchAIL pickles, folders of DrQ-v2 or "
    "V-D4RL episodes (.npz), videos (mp4, mov, gif, webm, mkv, avi), Minari datasets, "
    "LeRobot v3 datasets"
)


class PixelEpisodes(NamedTuple):
    """K episodes, padded to the longest."""

    recording: Recording  # its episodes are exhausted
    frames: np.ndarray  # uint8 [K, N + 1, S, S, 3], padded with the last frame
    num_frames: np.ndarray  # without padding. Shape [K]
    actions: np.ndarray | None  # float32 [K, N, A], padded with zeros; None if unknown
    rewards: np.ndarray | None  # float32 [K, N], padded with zeros; None if unknown
    stored_size: tuple[int, int]  # height and width of the first episode in the file


def open_recording(
    path: pathlib.Path,
    *,
    max_bytes: int,
    frame_skip: int = 1,
    image_size: int | None = None,
    keep_aspect: bool = False,
) -> Recording:
    """Opens a file or folder; its content decides the format.

    Args:
      path: file or folder.
      max_bytes: limit of each unpacked array.
      frame_skip: keeps every n-th frame, and sums the rewards in between.
      image_size: height and width of the frames; None keeps the file's.
      keep_aspect: only shrinks videos, until their shorter side is `image_size`; other
        formats keep their size.

    Returns:
      The recording, whose episodes are checked as they are read.

    Raises:
      FormatError: unknown format, or the file breaks its format's rules.
    """
    try:
        require_regular(path, or_folder=True)
    except ValueError as error:
        raise FormatError(str(error)) from error
    reader = next((reader for reader in _READERS if reader.recognises(path)), None)
    if reader is None:
        raise FormatError(f"is cut off, damaged or in an unsupported format: {FORMATS}")
    options = ReadOptions(max_bytes, frame_skip, image_size, keep_aspect)
    if reader in _IN_PROCESS:
        items = checked(reader.read(path, options))
    else:
        items = read_in_child(reader.read, path, options)
    recording = next(items)
    repeat, speed = recording.action_repeat, recording.frames_per_second
    if reader is videos:  # it has skipped frames already
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
    """Reads the first episodes, resized with antialiasing.

    `max_bytes` limits the result and every intermediate array; for the other arguments
    see `open_recording`.

    Raises:
      FormatError: see `open_recording`; or too few episodes, or too many bytes.
    """
    recording = open_recording(
        path, max_bytes=max_bytes, frame_skip=frame_skip, image_size=image_size
    )
    if num_episodes > recording.num_episodes:
        raise FormatError(
            f"holds {recording.num_episodes} episodes, but num_episodes={num_episodes}"
        )
    episodes, num_bytes = [], 0
    for episode in itertools.islice(recording.episodes, num_episodes):
        episodes.append(episode)
        num_bytes += episode.frames.nbytes
        if num_bytes > max_bytes:
            raise FormatError(
                f"needs more than {max_bytes} bytes for {len(episodes)} episodes at "
                f"{image_size}x{image_size} pixels"
            )
    if len(episodes) < num_episodes:
        raise FormatError(f"ends after {len(episodes)} of {num_episodes} episodes")
    return PixelEpisodes(
        recording,
        _padded([episode.frames for episode in episodes], repeat_last=True),
        np.array([len(episode.frames) for episode in episodes]),
        _stacked("actions", [episode.actions for episode in episodes]),
        _stacked("rewards", [episode.rewards for episode in episodes]),
        episodes[0].stored_size or (image_size, image_size),
    )


def _fitted(
    items: Iterator[PixelEpisode | None], frame_skip: int, image_size: int | None
) -> Iterator[PixelEpisode]:
    """Skips frames and resizes the others."""
    for index, episode in enumerate(item for item in items if item is not None):
        frames, actions, rewards, stored_size = episode
        num_steps = (len(frames) - 1) // frame_skip
        if num_steps < 1:
            what = f"has {len(frames)} frames in episode {index}"
            raise FormatError(f"{what}, too few for frame_skip={frame_skip}")
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


def _stacked(name: str, values: list[np.ndarray | None]) -> np.ndarray | None:
    """Pads with zeros and stacks; None if an episode has none."""
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
    stacked = np.zeros((len(arrays), longest, *arrays[0].shape[1:]), arrays[0].dtype)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
        if repeat_last:
            row[len(array) :] = array[-1]
    return stacked
