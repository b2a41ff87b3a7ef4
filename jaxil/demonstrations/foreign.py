"""Reads files of pixels in any supported format, resized for the agent."""

import itertools
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxil.demonstrations.readers import (
    hdf5,
    lerobot,
    minari,
    own,
    pickles,
    pictures,
    replays,
    videos,
)
from jaxil.demonstrations.readers.frames import resized
from jaxil.demonstrations.readers.recording import (
    FormatError,
    PixelEpisode,
    ReadOptions,
    Recording,
    checked,
)
from jaxil.demonstrations.readers.sandbox import read_in_child
from jaxil.demonstrations.types import Demonstrations, Wanted, returns_of
from jaxil.errors import printable
from jaxil.files.untrusted import require_regular

# The first that recognises a file reads it. Datasets may contain videos, and folders
# of videos pictures.
_READERS: tuple[Any, ...] = (
    own,
    pickles,
    minari,
    lerobot,
    replays,
    hdf5,
    videos,
    pictures,
)
# Safe without a child process: parsed in Python, and checked before unpacking.
_IN_PROCESS = (own, replays)
FORMATS = (
    "jaxil states or pixels (.npz as jaxil writes it), ROT or PatchAIL pickles, "
    "folders of DrQ-v2 or V-D4RL episodes (.npz, .hdf5), videos (mp4, mov, gif, webm, "
    "mkv, avi), folders of PNG or JPEG frames, NumPy images (.npy), Minari datasets, "
    "LeRobot v3 datasets"
)

# How many of a file's frames make an agent step; the nearest one is taken.
FramesPerStep = Callable[[Recording], float]


def open_recording(
    path: pathlib.Path,
    *,
    action_repeat: int = 0,
    frames_per_step: FramesPerStep | None = None,
    **options: Any,
) -> Recording:
    """Opens a file or folder, whose content decides the format.

    The episodes are checked as they are read. Rewards of skipped frames are summed.

    Args:
      path: file or folder.
      action_repeat: of the stored steps, if the file does not say it; 0 if unknown.
      frames_per_step: samples frames by time; None takes every `frame_skip`-th.
      options: the fields of `ReadOptions`. With `keep_aspect`, formats other than
        videos and pictures keep their size.

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
    asked = ReadOptions(**options)
    if reader in _IN_PROCESS:
        items = checked(reader.read(path, asked))
    else:
        items = read_in_child(reader.read, path, asked)
    recording = next(items)
    repeat = recording.action_repeat or action_repeat or None
    speed = recording.frames_per_second
    stride: float = asked.frame_skip
    if reader is videos:  # it skips frames itself, and its frame rate says so
        repeat, stride = repeat and repeat * asked.frame_skip, 1
    recording = recording._replace(action_repeat=repeat)
    if frames_per_step is not None:
        stride = frames_per_step(recording)
    return recording._replace(
        episodes=_fitted(items, stride, asked),
        task=recording.task and printable(recording.task),
        origin=recording.origin and printable(recording.origin, 200),
        action_repeat=repeat and round(repeat * stride),
        frames_per_second=speed and speed / stride,
        notes=tuple(printable(note, 200) for note in recording.notes),
    )


def read_episodes(
    path: pathlib.Path, wanted: Wanted, frames_per_step: FramesPerStep | None
) -> Demonstrations:
    """Reads the first episodes, resized with antialiasing.

    `max_bytes` limits all arrays of the result together, and every intermediate one.

    Raises:
      FormatError: see `open_recording`; or too few episodes, or too many bytes.
    """
    image_size, max_bytes = wanted.image_size, wanted.max_bytes
    recording = open_recording(
        path,
        action_repeat=wanted.stated_action_repeat,
        frames_per_step=frames_per_step,
        max_bytes=max_bytes,
        frame_skip=wanted.frame_skip,
        image_size=image_size,
        fit=wanted.fit,
        camera=wanted.dataset_camera,
    )
    num_episodes = wanted.num_episodes
    if wanted.takes_fewer:
        num_episodes = min(num_episodes, recording.num_episodes)
    if num_episodes > recording.num_episodes:
        raise FormatError(
            f"holds {recording.num_episodes} episodes, but num_episodes={num_episodes};"
            f" set demonstrations.num_episodes={recording.num_episodes}"
        )
    episodes, longest_bytes = [], [0, 0, 0]
    for episode in itertools.islice(recording.episodes, num_episodes):
        episodes.append(episode)
        arrays = (episode.frames, episode.actions, episode.rewards)
        own_bytes = [0 if array is None else array.nbytes for array in arrays]
        longest_bytes = [*map(max, longest_bytes, own_bytes)]
        # All are padded to the longest.
        if len(episodes) * sum(longest_bytes) > max_bytes:
            raise FormatError(
                f"needs more than {max_bytes} bytes for {len(episodes)} episodes at "
                f"{image_size}x{image_size} pixels"
            )
    if len(episodes) < num_episodes:
        raise FormatError(f"ends after {len(episodes)} of {num_episodes} episodes")
    rewards = _stacked("rewards", [episode.rewards for episode in episodes])
    return Demonstrations(
        frames=_padded([episode.frames for episode in episodes], repeat_last=True),
        num_frames=np.array([len(episode.frames) for episode in episodes]),
        actions=_stacked("actions", [episode.actions for episode in episodes]),
        task_rewards=rewards,
        metadata={
            "task": recording.task,
            "file": str(path),
            "kind": recording.kind,
            "action_repeat": recording.action_repeat,
            "frames_per_second": recording.frames_per_second,
            "stored_size": episodes[0].stored_size,
            "notes": recording.notes,
            "returns": returns_of(rewards),
        },
    )


def _fitted(
    items: Iterator[PixelEpisode | None], stride: float, options: ReadOptions
) -> Iterator[PixelEpisode]:
    """Yields episodes of every `stride`-th frame, resized; below 1, frames repeat."""
    image_size = None if options.keep_aspect else options.image_size
    for index, episode in enumerate(item for item in items if item is not None):
        frames, actions, rewards, stored_size = episode
        num_steps = int((len(frames) - 1) / stride + 1e-6)
        if num_steps < 1:
            what = f"has {len(frames)} frames in episode {index}"
            skip = f"frame_skip={stride}" if isinstance(stride, int) else "one step"
            raise FormatError(f"{what}, too few for {skip}")
        if stride < 1 and frames.nbytes > options.max_bytes * stride:
            raise FormatError(
                f"has so few frames per step in episode {index}, {stride:.3g}, that "
                f"repeating them takes more than the {options.max_bytes} bytes allowed"
            )
        if stride != 1:
            # Not `rint`, by which every other half would be the even one.
            times = np.floor(np.arange(num_steps + 1) * stride + 0.5).astype(int)
            frames = frames[times]
            if actions is not None:
                # The last step may be nearest to the last frame, which has no action.
                actions = actions[np.minimum(times[:-1], len(actions) - 1)]
            if rewards is not None:
                sums = np.append(0.0, np.cumsum(rewards, dtype=np.float64))
                rewards = np.diff(sums[times]).astype(np.float32)
        height, width = stored_size or frames.shape[1:3]
        if image_size is not None and frames.shape[1:3] != (image_size, image_size):
            num_bytes = len(frames) * image_size**2 * 3
            options.check_bytes(f"frames at {image_size}x{image_size}", num_bytes)
            size = (image_size, image_size)
            frames = np.stack([resized(x, size, options.fit) for x in frames])
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
    shape = (len(arrays), max(map(len, arrays)), *arrays[0].shape[1:])
    stacked = np.zeros(shape, arrays[0].dtype)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
        if repeat_last:
            row[len(array) :] = array[-1]
    return stacked
