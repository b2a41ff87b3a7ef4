"""Where a LeRobot dataset of version 3 keeps what: its files and their parts.

Source of the format: huggingface/lerobot, src/lerobot/datasets.
"""

import os
import pathlib
import re
from typing import NamedTuple

import numpy as np

from jaxil.demonstrations.readers import json_file, lerobot_file, messages
from jaxil.demonstrations.readers.recording import FormatError

INFO = "meta/info.json"
_MAX_INFO_BYTES = 16 * 1024**2
_MAX_EPISODES = 1_000_000
_MAX_FRAMES = 10_000_000  # in an episode
_MAX_FPS = 1e6
_MAX_NAME = 200  # letters of a camera
_REWARDS = ("next.reward", "reward")
_PLACE = re.compile(r"\{(video_key|chunk_index|file_index)(?::0?(\d)d)?\}")


class Dataset(NamedTuple):
    """What meta/info.json says.

    Attributes:
      root: the dataset's folder.
      fps: frames per second.
      camera: the name of its only camera.
      is_video: whether that one's pictures are in videos, or beside the actions.
      columns: names of the columns of actions and rewards, those that there are.
      paths: templates of the paths of data and videos.
      num_episodes: how many it has.
    """

    root: pathlib.Path
    fps: float
    camera: str
    is_video: bool
    columns: dict[str, str]
    paths: dict[str, str]
    num_episodes: int


class Episode(NamedTuple):
    """Where an episode is.

    Attributes:
      index: its number.
      length: frames.
      data: the file of its actions.
      video: the file of its frames, where it is a video.
      start_seconds: when it begins in there.
    """

    index: int
    length: int
    data: pathlib.Path
    video: pathlib.Path | None
    start_seconds: float


def read_info(root: pathlib.Path) -> tuple[Dataset, tuple[str, ...]]:
    """Returns what the dataset says of itself, checked, and notes about it."""
    info = json_file.read_object(inside(root, INFO), max_bytes=_MAX_INFO_BYTES)
    version = info.get("codebase_version")
    if not isinstance(version, str) or not version.startswith("v3."):
        raise FormatError(
            f"has codebase_version {version!r:.50}; only v3 can be read, to which "
            "LeRobot converts older ones"
        )
    fps, features, num_episodes = (
        info.get(name) for name in ("fps", "features", "total_episodes")
    )
    if not isinstance(fps, int | float) or not 0 < fps <= _MAX_FPS:
        raise FormatError(f"has fps={fps!r:.50} in {INFO}")
    if not isinstance(num_episodes, int) or not 0 < num_episodes <= _MAX_EPISODES:
        raise FormatError(f"has total_episodes={num_episodes!r:.50} in {INFO}")
    if not isinstance(features, dict):
        raise FormatError(f"has no features in {INFO}")
    kinds = {
        name: feature.get("dtype") if isinstance(feature, dict) else None
        for name, feature in features.items()
    }
    cameras = [name for name, kind in kinds.items() if kind in ("video", "image")]
    if len(cameras) != 1:
        listed = ", ".join(name if name.isprintable() else "?" for name in cameras)
        raise FormatError(f"has {len(cameras)} cameras, not one: {listed}"[:500])
    (camera,) = cameras
    if not camera.isprintable() or len(camera) > _MAX_NAME:
        raise FormatError(f"has a camera of the name {camera!r:.50}")
    is_video = kinds[camera] == "video"
    paths = {}
    for name in ("data", "video") if is_video else ("data",):
        paths[name] = info.get(f"{name}_path")
        if not isinstance(paths[name], str):
            raise FormatError(f"has no {name}_path in {INFO}")
    columns, notes = {}, []
    if kinds.get("action") in ("float32", "float64"):
        columns["action"] = "actions"
    else:
        notes.append("Its actions are no real numbers, and not read.")
    for name in _REWARDS:
        if name in kinds and "rewards" not in columns.values():
            columns[name] = "rewards"
    dataset = Dataset(root, float(fps), camera, is_video, columns, paths, num_episodes)
    return dataset, tuple(notes)


def find_episodes(dataset: Dataset, max_bytes: int) -> list[Episode]:
    """Reads where all episodes are."""
    video = f"videos/{dataset.camera}"
    columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    if dataset.is_video:
        columns += [f"{video}/chunk_index", f"{video}/file_index"]
        columns += [f"{video}/from_timestamp"]
    pieces = []
    for file in sorted(dataset.root.glob("meta/episodes/*/*.parquet")):
        file = inside(dataset.root, file.relative_to(dataset.root).as_posix())
        child = messages.open_child(
            lerobot_file.__name__, file, max_bytes=max_bytes, columns=columns
        )
        with child:
            arrays = messages.receive(child, max_bytes=max_bytes).arrays
        for name in columns:
            kind = "f" if name.endswith("timestamp") else "i"
            if arrays[name].ndim != 1 or arrays[name].dtype.kind != kind:
                raise FormatError(
                    f"has a column {name} of type {arrays[name].dtype} and shape "
                    f"{arrays[name].shape}"
                )
        pieces.append(arrays)
    table = {
        name: np.concatenate([piece[name] for piece in pieces]).tolist()
        if pieces
        else []
        for name in columns
    }
    if sorted(table["episode_index"]) != list(range(dataset.num_episodes)):
        raise FormatError(
            f"has {len(table['episode_index'])} episodes in meta/episodes, which are "
            f"not those from 0 to {dataset.num_episodes - 1}"
        )
    rows = zip(*(table[name] for name in columns), strict=True)
    return [_episode(dataset, *row) for row in sorted(rows)]


def _episode(
    dataset: Dataset,
    index: int,
    length: int,
    chunk_index: int,
    file_index: int,
    video_chunk_index: int = 0,
    video_file_index: int = 0,
    start_seconds: float = 0.0,
) -> Episode:
    """Returns a row of meta/episodes, checked."""
    if not 2 <= length <= _MAX_FRAMES:
        raise FormatError(f"has {length} frames in episode {index}; 2 are needed")
    if not 0 <= start_seconds <= _MAX_FRAMES / dataset.fps:
        raise FormatError(f"has an episode {index} from second {start_seconds} on")
    data = _file(dataset, "data", chunk_index, file_index)
    video = None
    if dataset.is_video:
        video = _file(dataset, "video", video_chunk_index, video_file_index)
    return Episode(index, length, data, video, start_seconds)


def _file(
    dataset: Dataset, kind: str, chunk_index: int, file_index: int
) -> pathlib.Path:
    """Fills in a template of a path."""
    values = {
        "video_key": dataset.camera,
        "chunk_index": chunk_index,
        "file_index": file_index,
    }

    def fill(place: re.Match[str]) -> str:
        value, digits = values[place[1]], int(place[2] or 0)
        return f"{value:0{digits}d}" if isinstance(value, int) else value

    # Not by str.format, whose language could do more than that.
    return inside(dataset.root, _PLACE.sub(fill, dataset.paths[kind]))


def inside(root: pathlib.Path, relative: str) -> pathlib.Path:
    """Returns the true path of a dataset's file.

    Raises:
      FormatError: it is not in the dataset's folder.
    """
    parts = pathlib.PurePosixPath(relative).parts
    is_name = parts and parts[0] != "/" and ".." not in parts
    if not is_name or not relative.isprintable():
        raise FormatError(f"refers to a file {relative!r:.200}, which is not in it")
    true_root = os.path.realpath(root)
    path = os.path.realpath(os.path.join(true_root, *parts))
    if os.path.commonpath([path, true_root]) != true_root:
        raise FormatError(
            f"has a link to somewhere else in {relative!r:.200}; copy the folder with "
            "`cp -rL`, which follows links"
        )
    return pathlib.Path(path)
