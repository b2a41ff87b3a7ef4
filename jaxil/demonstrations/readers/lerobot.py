"""LeRobot datasets of version 3: one camera, actions and rewards.

LeRobot stores action t with frame t, but no frame after the last action. That action is
dropped: an episode of L frames has L - 1 steps. The reward of action t is
`next.reward`, or else `reward`.

Source of the format: huggingface/lerobot, src/lerobot/datasets.
"""

import itertools
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxil.demonstrations.readers import videos
from jaxil.demonstrations.readers.frames import decode_pictures
from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    ReadOptions,
    Recording,
    first_bytes,
    read_json,
)
from jaxil.files.untrusted import open_regular

_INFO = "meta/info.json"
_MAX_EPISODES = 1_000_000
_MAX_FPS = 1e6
_MAX_RATE_ERROR = 0.001  # relative, of a video's frame rate


class _Dataset(NamedTuple):
    """The content of meta/info.json."""

    root: pathlib.Path
    fps: float
    num_episodes: int
    camera: str  # name of the one that is read
    is_video: bool  # whether its images are in videos, not in the Parquet files
    columns: dict[str, str]  # of "actions" and "rewards", if present
    paths: dict[str, Any]  # path templates of "data" and "video"


class _Location(NamedTuple):
    """Where an episode is stored; `start_seconds` is its start in the video."""

    index: int
    length_frames: int
    data: pathlib.Path
    video: pathlib.Path | None
    start_seconds: float


def recognises(path: pathlib.Path) -> bool:
    """Returns whether this is the folder of a LeRobot dataset."""
    return b'"codebase_version"' in first_bytes(path / _INFO, 4096)


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads one camera of a dataset; opens no file outside its folder."""
    dataset = _read_info(path, options.camera)
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise FormatError("needs pyarrow: pip install pyarrow") from None
    episodes = _find_episodes(dataset)
    notes = ()
    if "actions" not in dataset.columns:
        notes = ("Its actions are ignored, because they are not real numbers.",)
    fps = dataset.fps
    yield Recording(
        "LeRobot dataset", len(episodes), frames_per_second=fps, notes=notes
    )
    rows = _rows(dataset, episodes, options)
    shots = _video_frames(dataset, episodes, options) if dataset.is_video else None
    for episode in episodes:
        values = next(rows)
        if shots is None:
            yield PixelEpisode(stored_size=None, **values)
            continue
        while (shown := next(shots)) is None:
            yield None
        if len(shown.frames) != episode.length_frames:
            raise FormatError(
                f"has a video that ends after {len(shown.frames)} of the "
                f"{episode.length_frames} frames of episode {episode.index}"
            )
        yield shown._replace(**values)


def _read_info(root: pathlib.Path, camera: str) -> _Dataset:
    """Reads and checks meta/info.json."""
    info = read_json(_inside(root, _INFO))
    version, features = info.get("codebase_version"), info.get("features")
    if not str(version).startswith("v3."):
        what = f"has codebase_version {version!r:.50}"
        raise FormatError(f"{what}, not v3; LeRobot can convert older datasets")
    for name, kind, most in (
        ("fps", int | float, _MAX_FPS),
        ("total_episodes", int, _MAX_EPISODES),
    ):
        if not isinstance(info.get(name), kind) or not 1 / most <= info[name] <= most:
            raise FormatError(f"has {name}={info.get(name)!r:.50} in {_INFO}")
    if not isinstance(features, dict):
        raise FormatError(f"has no features in {_INFO}")
    kinds = {
        name: feature.get("dtype") if isinstance(feature, dict) else None
        for name, feature in features.items()
    }
    cameras = [name for name, kind in kinds.items() if kind in ("video", "image")]
    if camera in cameras:
        cameras = [camera]
    elif camera:
        raise FormatError(f"has no camera {camera!r}, but: {', '.join(cameras)}")
    if len(cameras) != 1:
        way_out = "; choose one with demonstrations.camera=NAME" if cameras else ""
        names = ", ".join(cameras)
        raise FormatError(f"has {len(cameras)} cameras, not one: {names}{way_out}")
    is_video = kinds[cameras[0]] == "video"
    paths = {name: info.get(f"{name}_path") for name in ("data", "video")}
    for name in paths if is_video else ("data",):
        if not isinstance(paths[name], str):
            raise FormatError(f"has no {name}_path in {_INFO}")
    columns = {}
    if kinds.get("action") in ("float32", "float64"):
        columns["actions"] = "action"
    for name in ("reward", "next.reward"):  # the latter if both exist
        if name in kinds:
            columns["rewards"] = name
    fps, num_episodes = float(info["fps"]), info["total_episodes"]
    return _Dataset(root, fps, num_episodes, cameras[0], is_video, columns, paths)


def _find_episodes(dataset: _Dataset) -> list[_Location]:
    """Returns where each episode is stored, in order of their indices."""
    video = f"videos/{dataset.camera}/"
    names = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    if dataset.is_video:
        names += [f"{video}chunk_index", f"{video}file_index", f"{video}from_timestamp"]
    rows = []
    for file in sorted(dataset.root.glob("meta/episodes/*/*.parquet")):
        file = _inside(dataset.root, file.relative_to(dataset.root).as_posix())
        rows += _read_table(file, names).to_pylist()
    episodes = []
    for row in rows:
        integers = list(row.values())
        start = integers.pop() if dataset.is_video else 0.0
        is_known = all(isinstance(value, int) for value in integers)
        if not is_known or not isinstance(start, float) or not 0 <= start < 1e9:
            raise FormatError(f"has an episode with an invalid location: {row}")
        index, length, *numbers = integers
        if length < 2:
            raise FormatError(f"has {length} frames in episode {index}; 2 are needed")
        data = _file(dataset, "data", *numbers[:2])
        video_file = _file(dataset, "video", *numbers[2:]) if dataset.is_video else None
        episodes.append(_Location(index, length, data, video_file, start))
    episodes.sort()
    if [episode.index for episode in episodes] != list(range(dataset.num_episodes)):
        wanted = f"0 to {dataset.num_episodes - 1}"
        raise FormatError(f"has {len(rows)} episodes, not {wanted}")
    return episodes


def _rows(
    dataset: _Dataset, episodes: Sequence[_Location], options: ReadOptions
) -> Iterator[dict[str, np.ndarray]]:
    """Yields each PixelEpisode's fields that are in the Parquet files."""
    names = ["episode_index", "frame_index", *dataset.columns.values()]
    if not dataset.is_video:
        names.append(dataset.camera)
    for file, group in itertools.groupby(episodes, lambda episode: episode.data):
        table = _read_table(file, names)
        indices = _numbers(table, "episode_index")
        for episode in group:
            rows = table.take(np.flatnonzero(indices == episode.index))
            options.check_bytes(f"rows of episode {episode.index}", rows.nbytes)
            times = np.arange(episode.length_frames)
            if not np.array_equal(_numbers(rows, "frame_index"), times):
                what = f"the {len(times)} rows of episode {episode.index}"
                raise FormatError(f"does not have {what} in {file.name}")
            values = {
                name: _numbers(rows, column)[:-1]
                for name, column in dataset.columns.items()
            }
            if "actions" in values:
                values["actions"] = values["actions"].reshape(len(times) - 1, -1)
            if not dataset.is_video:
                files = rows[dataset.camera].to_pylist()
                values["frames"] = decode_pictures(_contents(files), options)
            yield values


def _video_frames(
    dataset: _Dataset, episodes: Sequence[_Location], options: ReadOptions
) -> Iterator[PixelEpisode | None]:
    """Yields each episode's frames, and None as a heartbeat."""
    options = options._replace(frame_skip=1)
    for file, group in itertools.groupby(episodes, lambda episode: episode.video):
        assert file is not None
        rate, is_even = videos.timing(file)
        if not rate or not is_even or abs(rate / dataset.fps - 1) > _MAX_RATE_ERROR:
            raise FormatError(
                f"has a video {file.name} of {rate or 0:.4g} frames per second, but "
                f"{_INFO} says {dataset.fps:.4g}"
            )
        decoded, num_seen = videos.decode(file, options), 0
        for episode in group:
            skipped = round(episode.start_seconds * rate) - num_seen
            if skipped < 0:
                raise FormatError(
                    f"has an episode {episode.index} that overlaps another"
                )
            for _ in itertools.islice(decoded, skipped):
                yield None
            num_seen += skipped + episode.length_frames
            own = itertools.islice(decoded, episode.length_frames)
            yield from videos.collect(own, options)


def _read_table(file: pathlib.Path, names: Sequence[str]) -> Any:
    from pyarrow import parquet

    with open_regular(file) as opened, parquet.ParquetFile(opened) as content:
        missing = [name for name in names if name not in content.schema_arrow.names]
        if missing:
            raise FormatError(f"has no column {', '.join(missing)} in {file.name}")
        return content.read(columns=list(names), use_threads=False).select(names)


def _numbers(table: Any, name: str) -> np.ndarray:
    """Returns a column of numbers, or of vectors of one length."""
    try:
        values = np.array(table[name].to_pylist())
    except ValueError as error:
        raise FormatError(f"has rows of unequal lengths in {name}") from error
    if values.dtype.kind not in "biuf":
        raise FormatError(f"has rows that are not numbers in {name}")
    return values


def _contents(files: Sequence[Any]) -> list[bytes]:
    """Returns the bytes of image files."""
    contents = [file.get("bytes") for file in files if isinstance(file, dict)]
    known = [content for content in contents if isinstance(content, bytes)]
    if len(known) < len(files):
        raise FormatError("does not store its images in the Parquet files")
    return known


def _file(
    dataset: _Dataset, kind: str, chunk_index: int, file_index: int
) -> pathlib.Path:
    """Fills in a path template."""
    values = {"chunk_index": chunk_index, "file_index": file_index}
    try:
        name = dataset.paths[kind].format(video_key=dataset.camera, **values)
    except (LookupError, AttributeError, ValueError) as error:
        raise FormatError(f"has {kind}_path={dataset.paths[kind]!r:.200}") from error
    return _inside(dataset.root, name)


def _inside(root: pathlib.Path, relative: str) -> pathlib.Path:
    """Returns the real path of a file; FormatError if it is outside the folder."""
    parts = pathlib.PurePosixPath(relative).parts
    is_name = parts and parts[0] != "/" and ".." not in parts and len(relative) < 4096
    if not is_name or not relative.isprintable():
        raise FormatError(f"refers to a file {relative!r:.200} outside its folder")
    true_root = os.path.realpath(root)
    path = os.path.realpath(os.path.join(true_root, *parts))
    if os.path.commonpath([path, true_root]) != true_root:
        what = f"has a link that leaves its folder in {relative!r:.200}"
        raise FormatError(f"{what}; copy the folder with `cp -rL`, which follows links")
    return pathlib.Path(path)
