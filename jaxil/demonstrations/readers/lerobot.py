"""LeRobot datasets of version 3: one camera, actions and rewards."""

import contextlib
import importlib.util
import itertools
import pathlib
from collections.abc import Generator, Iterator, Sequence

import numpy as np

from jaxil.demonstrations.readers import clips, lerobot_file, lerobot_index, messages
from jaxil.demonstrations.readers.lerobot_index import Dataset, Episode
from jaxil.demonstrations.readers.recording import FormatError, PixelEpisode, Recording

_HEAD_BYTES = 4096  # of meta/info.json, where the key is that tells the format
_MAX_RATE_ERROR = 0.001  # of a video's frames per second against the dataset's


def recognises(path: pathlib.Path) -> bool:
    """Tells whether this is the folder of a LeRobot dataset; never raises."""
    try:
        if not (path / lerobot_index.INFO).is_file():
            return False
        with (path / lerobot_index.INFO).open("rb") as file:
            return b'"codebase_version"' in file.read(_HEAD_BYTES)
    except (OSError, ValueError):
        return False


def open_recording(path: pathlib.Path, *, max_bytes: int) -> Recording:
    """Opens a dataset that has exactly one camera.

    LeRobot stores with frame t the action that was taken there, and no frame that shows
    what the last one led to: that action is dropped, and an episode of L frames has
    L - 1 steps. `next.reward`, or else `reward`, is what arrived after the action.

    Args:
      path: the dataset's folder. Nothing outside of it is opened.
      max_bytes: of one episode's frames.

    Raises:
      FormatError: it is no such dataset, or pyarrow is not installed.
      OSError: a file cannot be opened.
    """
    dataset, notes = lerobot_index.read_info(path)
    if importlib.util.find_spec("pyarrow") is None:
        raise FormatError("needs pyarrow: pip install 'jaxil[lerobot]'")
    episodes = lerobot_index.find_episodes(dataset, max_bytes)
    return Recording(
        kind="LeRobot dataset",
        num_episodes=len(episodes),
        episodes=_read_episodes(dataset, episodes, max_bytes),
        frames_per_second=dataset.fps,
        notes=notes,
    )


def _read_episodes(
    dataset: Dataset, episodes: Sequence[Episode], max_bytes: int
) -> Iterator[PixelEpisode]:
    rows = _rows(dataset, episodes, max_bytes)
    videos = _videos(dataset, episodes, max_bytes) if dataset.is_video else None
    # Each holds a running program, which ends with it.
    with contextlib.closing(rows), contextlib.closing(videos or rows):
        for episode in episodes:
            values = next(rows)
            frames = values.pop("frames") if videos is None else next(videos)
            for name, array in values.items():
                if len(array) != episode.length:
                    raise FormatError(
                        f"has {len(array)} {name} in episode {episode.index}, where "
                        f"{episode.length} belong"
                    )
            yield PixelEpisode(
                frames, **{name: array[:-1] for name, array in values.items()}
            )


def _rows(
    dataset: Dataset, episodes: Sequence[Episode], max_bytes: int
) -> Generator[dict[str, np.ndarray], None, None]:
    """Yields actions [L, A] and rewards [L] of each episode, and frames if there."""
    for file, group in itertools.groupby(episodes, lambda episode: episode.data):
        child = messages.open_child(
            lerobot_file.__name__,
            file,
            max_bytes=max_bytes,
            columns=["frame_index", *dataset.columns],
            image=None if dataset.is_video else dataset.camera,
            split="episode_index",
        )
        with child:
            for episode in group:
                message = messages.receive(child, max_bytes=max_bytes)
                arrays = dict(message.arrays)
                times = arrays.pop("frame_index")
                if message.facts["value"] != episode.index or not np.array_equal(
                    times, np.arange(episode.length)
                ):
                    raise FormatError(
                        f"has other rows in {file.name} than the {episode.length} of "
                        f"episode {episode.index}"
                    )
                values = {"frames": arrays["frames"]} if "frames" in arrays else {}
                with np.errstate(all="ignore"):  # too large a number becomes infinite
                    for column, name in dataset.columns.items():
                        values[name] = arrays[column].astype(np.float32)
                if values.get("actions", np.empty((0, 0))).ndim == 1:
                    values["actions"] = values["actions"][:, None]
                if "rewards" in values:
                    values["rewards"] = values["rewards"].reshape(-1)
                yield values


def _videos(
    dataset: Dataset, episodes: Sequence[Episode], max_bytes: int
) -> Generator[np.ndarray, None, None]:
    """Yields the frames of each episode, uint8 [L, H, W, 3]."""
    for file, group in itertools.groupby(episodes, lambda episode: episode.video):
        assert file is not None
        clip = clips.probe(file)
        rate = clip.frames_per_second or 0.0
        if not clip.is_even or abs(rate / dataset.fps - 1) > _MAX_RATE_ERROR:
            raise FormatError(
                f"has a video {file.name} of {rate:.4g} frames per second, where "
                f"{lerobot_index.INFO} says {dataset.fps:.4g}"
            )
        seconds = clips.cpu_seconds_for(clip, file.stat().st_size)
        decoded = clips.decode(file, max_frame_bytes=max_bytes, cpu_seconds=seconds)
        num_seen = 0
        with contextlib.closing(decoded):
            for episode in group:
                skipped = round(episode.start_seconds * rate) - num_seen
                if skipped < 0:
                    raise FormatError(
                        f"has an episode {episode.index} that begins in the one before"
                    )
                num_seen += skipped + episode.length
                frames = itertools.islice(decoded, skipped, skipped + episode.length)
                yield _stack(episode, frames, max_bytes)


def _stack(
    episode: Episode, frames: Iterator[np.ndarray], max_bytes: int
) -> np.ndarray:
    """Returns an episode's frames in one array."""
    stacked, count = np.empty(0, np.uint8), 0
    for frame in frames:
        if not count:
            height, width, _ = frame.shape
            clips.check_size(episode.length, height, width, max_bytes)
            stacked = np.empty((episode.length, *frame.shape), np.uint8)
        stacked[count] = frame
        count += 1
    if count != episode.length:
        raise FormatError(
            f"has a video that ends after {count} of the {episode.length} frames of "
            f"episode {episode.index}"
        )
    return stacked
