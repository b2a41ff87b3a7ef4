"""Foreign files of pixels, as episodes of the size that the agent sees."""

import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from jaxil.demonstrations.readers import lerobot, minari, own, pickles, replays, videos
from jaxil.demonstrations.readers.recording import FormatError, PixelEpisode, Recording
from jaxil.demonstrations.readers.validation import check_episode

# Asked in this order; each decides by content. Videos last: other datasets hold some.
_READERS: tuple[Any, ...] = (own, pickles, minari, lerobot, replays, videos)
FORMATS = (
    "jaxil states or pixels (.npz), ROT or PatchAIL pickles, folders of DrQ-v2 or "
    "V-D4RL episodes (.npz), videos (mp4, gif, webm), Minari and LeRobot v3 datasets"
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
    path: pathlib.Path, *, max_bytes: int, frame_skip: int = 1
) -> Recording:
    """Opens a file or folder of any known format, decided by content.

    Args:
      path: what to open.
      max_bytes: the largest array that may be unpacked.
      frame_skip: every so many-th frame is kept, and the rewards between are summed.

    Returns:
      The recording, whose episodes are checked as they are read.

    Raises:
      FormatError: no reader knows it, or it breaks its format's rules.
      OSError: it can't be opened.
    """
    path.stat()  # a file that is missing is no question of formats
    for reader in _READERS:
        if reader.recognises(path):
            if reader is videos:  # a long video need not be unpacked whole
                recording = reader.open_recording(
                    path, max_bytes=max_bytes, frame_skip=frame_skip
                )
                return recording._replace(episodes=_checked(recording, frame_skip=1))
            recording = reader.open_recording(path, max_bytes=max_bytes)
            return _skipping(recording, frame_skip)
    raise FormatError(f"is cut off, damaged, or in no format that is read: {FORMATS}")


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
      image_size: height and width wanted, in pixels.
      frame_skip: every so many-th frame is kept.
      max_bytes: the memory that the result, and each array on the way, may take.

    Raises:
      FormatError: see `open_recording`; or it holds fewer episodes, or too much.
      OSError: it can't be opened.
    """
    recording = open_recording(path, max_bytes=max_bytes, frame_skip=frame_skip)
    if num_episodes > recording.num_episodes:
        raise FormatError(
            f"holds {recording.num_episodes} episodes, and "
            f"num_episodes={num_episodes} were asked for"
        )
    episodes, stored_size, num_bytes = [], (0, 0), 0
    for index, episode in enumerate(recording.episodes):
        if index == num_episodes:
            break
        if index == 0:
            stored_size = episode.frames.shape[1:3]
        num_bytes += len(episode.frames) * image_size * image_size * 3
        if num_bytes > max_bytes:
            raise FormatError(
                f"needs more than {max_bytes} bytes for {index + 1} episodes at "
                f"{image_size}x{image_size} pixels, which is more than can be spared"
            )
        episodes.append(episode._replace(frames=resized(episode.frames, image_size)))
    if len(episodes) < num_episodes:
        raise FormatError(f"ends after {len(episodes)} of {num_episodes} episodes")
    return PixelEpisodes(
        recording,
        _padded([episode.frames for episode in episodes], repeat_last=True),
        np.array([len(episode.frames) for episode in episodes]),
        _together("actions", [episode.actions for episode in episodes]),
        _together("rewards", [episode.rewards for episode in episodes]),
        stored_size,
    )


def resized(frames: np.ndarray, size: int) -> np.ndarray:
    """Returns frames [N, size, size, 3] of frames [N, H, W, 3], with antialiasing.

    Pictures that are not square are squeezed into one. Frames that have the size
    already are returned as they are.
    """
    if frames.shape[1:3] == (size, size):
        return frames
    # Pillow's bilinear filter grows with the scale, so nothing is skipped over.
    return np.stack(
        [
            np.asarray(
                Image.fromarray(frame).resize((size, size), Image.Resampling.BILINEAR)
            )
            for frame in frames
        ]
    )


def of_size(recording: Recording, image_size: int) -> Recording:
    """Returns the recording with its frames resized as they are read."""

    def episodes() -> Iterator[PixelEpisode]:
        for episode in recording.episodes:
            yield episode._replace(frames=resized(episode.frames, image_size))

    return recording._replace(episodes=episodes())


def _checked(recording: Recording, *, frame_skip: int) -> Iterator[PixelEpisode]:
    for index, episode in enumerate(recording.episodes):
        check_episode(index, episode)
        if frame_skip > 1:
            num_steps = (len(episode.frames) - 1) // frame_skip
            if num_steps < 1:
                raise FormatError(
                    f"has {len(episode.frames)} frames in episode {index}, too few for "
                    f"frame_skip={frame_skip}"
                )
            used = num_steps * frame_skip
            actions, rewards = episode.actions, episode.rewards
            episode = PixelEpisode(
                episode.frames[: used + 1 : frame_skip],
                None if actions is None else actions[:used:frame_skip],
                None
                if rewards is None
                else rewards[:used].reshape(num_steps, frame_skip).sum(axis=1),
            )
        yield episode


def _skipping(recording: Recording, frame_skip: int) -> Recording:
    repeat, speed = recording.action_repeat, recording.frames_per_second
    return recording._replace(
        episodes=_checked(recording, frame_skip=frame_skip),
        action_repeat=None if repeat is None else repeat * frame_skip,
        frames_per_second=None if speed is None else speed / frame_skip,
    )


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
