"""Small valid files of each foreign format, as their own programs would write them."""

import io
import json
import pathlib
import pickle
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import av
import numpy as np
from PIL import Image

from jaxil.demonstrations.readers import own
from jaxil.demonstrations.readers.recording import (
    PixelEpisode,
    ReadOptions,
    Recording,
    checked,
)

CAMERA = "observation.images.front"  # in the datasets of LeRobot


def write_lerobot(path: pathlib.Path, seed: int) -> None:
    """A dataset's folder like LeRobot's of version 3, its video without loss."""
    rng = np.random.default_rng(seed)
    episodes = []
    for num_frames in (3, 5):
        episodes.append(
            {
                "frames": _random_frames(rng, num_frames),
                "action": rng.uniform(-1, 1, (num_frames, 2)).astype(np.float32),
                "next.reward": rng.uniform(size=num_frames).astype(np.float32),
            }
        )
    make_lerobot_dataset(path, episodes)


def make_lerobot_dataset(
    path: pathlib.Path,
    episodes: list[dict],
    *,
    as_images=False,
    per_file=2,
    gap=0,
    **info,
) -> None:
    """Writes a dataset as the documentation of LeRobot describes version 3.

    Args:
      path: the dataset's folder, which is made.
      episodes: each with frames [L, H, W, 3] and columns of L rows.
      as_images: whether pictures are PNGs beside the actions; else a video is made.
      per_file: episodes in a file.
      gap: frames before each episode that belong to none.
      **info: changes of meta/info.json.
    """
    rows = []
    for index, episode in enumerate(episodes):
        file, place = divmod(index, per_file)
        before = episodes[file * per_file : index]
        start = sum(len(other["frames"]) for other in before) + gap * (place + 1)
        rows.append(
            {
                "episode_index": index,
                "length": len(episode["frames"]),
                "data/chunk_index": 0,
                "data/file_index": file,
                f"videos/{CAMERA}/chunk_index": 0,
                f"videos/{CAMERA}/file_index": file,
                f"videos/{CAMERA}/from_timestamp": start / 10,
            }
        )
    make_parquet(path / "meta/episodes/chunk-000/file-000.parquet", rows)
    for file in range(-(-len(episodes) // per_file)):
        chosen = range(len(episodes))[file * per_file :][:per_file]
        _write_lerobot_file(path, file, episodes, chosen, as_images, gap)
    features = {
        name: {"dtype": str(np.asarray(values).dtype), "shape": [1]}
        for name, values in episodes[0].items()
        if name != "frames"
    }
    features[CAMERA] = {"dtype": "image" if as_images else "video", "shape": [8, 8, 3]}
    content = {
        "codebase_version": "v3.0",
        "fps": 10,
        "total_episodes": len(episodes),
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": (
            "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        ),
        "features": features,
        **info,
    }
    (path / "meta" / "info.json").write_text(json.dumps(content))


def _write_lerobot_file(path, file, episodes, chosen, as_images, gap) -> None:
    """Writes the data of some episodes, and the video of their frames."""
    rows, frames = [], []
    for index in chosen:
        episode = episodes[index]
        frames += [np.zeros_like(episode["frames"][:1])] * gap + [episode["frames"]]
        columns = {name: values for name, values in episode.items() if name != "frames"}
        for time in range(len(episode["frames"])):
            row = {"episode_index": index, "frame_index": time}
            row |= {name: values[time] for name, values in columns.items()}
            if as_images:
                picture = io.BytesIO()
                Image.fromarray(episode["frames"][time]).save(picture, "PNG")
                row[CAMERA] = {"bytes": picture.getvalue(), "path": f"{time}.png"}
            rows.append(row)
    name = f"chunk-000/file-{file:03d}"
    make_parquet(path / f"data/{name}.parquet", rows)
    if not as_images:
        video = path / f"videos/{CAMERA}/{name}.mp4"
        video.parent.mkdir(parents=True, exist_ok=True)
        encode_video(video, np.concatenate(frames), fps=10, g="2")


def make_parquet(path: pathlib.Path, rows: list[dict]) -> None:
    """Writes rows of values, or of lists of values."""
    import pyarrow
    from pyarrow import parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {
        name: [
            value.tolist() if hasattr(value, "tolist") else value for value in values
        ]
        for name in rows[0]
        for values in [[row[name] for row in rows]]
    }
    parquet.write_table(pyarrow.table(columns), path, row_group_size=4)


def write_minari(path: pathlib.Path, seed: int) -> None:
    """A dataset's folder as Minari writes it; too small for its JPEGs."""
    rng = np.random.default_rng(seed)
    episodes = []
    for num_steps in (3, 4):
        episodes.append(
            {
                "observations": _random_frames(rng, num_steps + 1),
                "actions": rng.uniform(-1, 1, (num_steps, 2)).astype(np.float32),
                "rewards": rng.uniform(size=num_steps),
            }
        )
    make_minari_dataset(path, episodes)


def make_minari_dataset(
    path: pathlib.Path, episodes: list[dict], *, observation_space=None, **options
) -> None:
    """Writes episodes by Minari.

    Args:
      path: the dataset's folder, which is made.
      episodes: each with observations, actions and rewards.
      observation_space: None for images like those of the first episode.
      **options: of Minari's storage.
    """
    import gymnasium
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    if observation_space is None:
        shape = episodes[0]["observations"].shape[1:]
        observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
    actions = np.asarray(episodes[0]["actions"])
    action_space = gymnasium.spaces.Discrete(9)
    if actions.dtype.kind == "f":
        action_space = gymnasium.spaces.Box(-1, 1, actions.shape[1:], np.float32)
    path.mkdir()
    storage = MinariStorage.new(
        path / "data",
        observation_space=observation_space,
        action_space=action_space,
        **options,
    )
    for episode in episodes:
        ends = [False] * len(episode["rewards"])
        buffer = EpisodeBuffer(**episode, terminations=ends, truncations=ends, infos={})
        storage.update_episodes([buffer])


def write_video(path: pathlib.Path, seed: int) -> None:
    """An MP4 file of one episode, whose every pixel is kept."""
    frames = _random_frames(np.random.default_rng(seed), num_frames=5)
    encode_video(path, frames, format="mp4")


def encode_video(
    path: pathlib.Path,
    frames: np.ndarray,
    codec: str = "libx264rgb",
    pixels: str = "rgb24",
    *,
    format: str | None = None,
    fps: Fraction | int = 25,
    times: Sequence[int] | None = None,
    container_options: dict[str, str] | None = None,
    **options: str,
) -> None:
    """Writes frames [T, H, W, 3], without loss unless the options say otherwise."""
    if codec == "libx264rgb":
        options = {"qp": "0", **options}
    options_ = container_options or {}
    with open_video(path, "w", format=format, options=options_) as container:
        stream = container.add_stream(codec, Fraction(fps), options=options)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = pixels
        for index, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture))
            frame = frame.reformat(format=pixels)
            frame.pts = index if times is None else times[index]
            frame.time_base = 1 / Fraction(fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def open_video(path: pathlib.Path, mode: Any = "r", **options: Any) -> Any:
    """Opens a video by PyAV, whose own types of streams are too many."""
    return av.open(path, mode, **options)


def read_here(reader: Any, path: pathlib.Path, **options: Any):
    """Returns what a reader's module reads, in this process, which is faster."""
    items = checked(reader.read(path, ReadOptions(**{"max_bytes": 2**24, **options})))
    recording = next(items)
    episodes = [item for item in items if item is not None]
    assert len(episodes) == recording.num_episodes
    return recording, episodes


def _random_frames(rng: np.random.Generator, num_frames: int, size=8) -> np.ndarray:
    """Returns noise of sixteen pixels, each drawn as a square. [T, size, size, 3]"""
    few = rng.integers(0, 256, (num_frames, 4, 4, 3), dtype=np.uint8)
    return few.repeat(size // 4, axis=1).repeat(size // 4, axis=2)


# --- ROT, PatchAIL, DrQ-v2, DreamerV2 -------------------------------------------------


def write_pickle(path: pathlib.Path, seed: int) -> None:
    """Two episodes as ROT writes them, in one of the forms and protocols by turns."""
    rng = np.random.default_rng(seed)
    protocol, form = 2 + seed % 4, PICKLE_FORMS[seed // 4 % len(PICKLE_FORMS)]
    lengths = (4, 4) if form == "arrays" else (3, 5)
    content = pickle_content([play(rng, length) for length in lengths], form)
    path.write_bytes(pickle.dumps(content, protocol))


def write_replays(path: pathlib.Path, seed: int) -> None:
    """A folder with two episodes of DrQ-v2, or of V-D4RL, and a file of neither."""
    rng = np.random.default_rng(seed)
    path.mkdir()
    (path / "notes.txt").write_text("other files may lie about")
    for index, num_steps in enumerate((3, 6)):
        entries = (drqv2_entries, dreamer_entries)[seed % 2](*play(rng, num_steps))
        save = (np.savez, np.savez_compressed)[seed // 2 % 2]
        name = f"20220101T00000{index}_{index}_{num_steps}.npz"
        save(path / name, allow_pickle=False, **entries)


def write_hdf5(path: pathlib.Path, seed: int) -> None:
    """Two episodes of V-D4RL, end to end."""
    import h5py

    rng = np.random.default_rng(seed)
    episodes = [drqv2_entries(*play(rng, num_steps)) for num_steps in (3, 6)]
    for entries in episodes:
        entries["reward"] = entries["reward"][:, 0]
        types = np.ones(len(entries["action"]), np.int64)
        types[0], types[-1] = 0, 2
        entries["step_type"] = types
    with h5py.File(path, "w") as file:
        for name in episodes[0]:
            file[name] = np.concatenate([entries[name] for entries in episodes])


def write_pictures(path: pathlib.Path, seed: int) -> None:
    """A folder of two episodes as PNG files, or a NumPy array of one."""
    rng = np.random.default_rng(seed)
    if seed % 2:
        with path.open("wb") as file:
            np.save(file, _random_frames(rng, 5))
        return
    for episode, length in enumerate((4, 3)):
        (path / f"episode{episode}").mkdir(parents=True)
        for index, frame in enumerate(_random_frames(rng, length)):
            Image.fromarray(frame).save(path / f"episode{episode}" / f"{index}.png")


PICKLE_FORMS = ("arrays", "object arrays", "lists of arrays", "lists of steps")


def play(rng: np.random.Generator, num_steps: int, size=8):
    """Returns frames [N + 1, S, S, 3], actions [N, 2], and the rewards after them."""
    frames = rng.integers(0, 256, (num_steps + 1, size, size, 3), dtype=np.uint8)
    actions = rng.uniform(0.1, 1, (num_steps, 2)).astype(np.float32)
    return frames, actions, rng.uniform(0.1, 1, num_steps).astype(np.float32)


def stacked(frames: np.ndarray, num_frames=3) -> np.ndarray:
    """Returns [T, 3 * num_frames, H, W]; the first frame stands for those before it."""
    times = np.arange(len(frames))[:, None] - np.arange(num_frames)[::-1]
    stacks = frames[np.maximum(times, 0)].transpose(0, 1, 4, 2, 3)
    return stacks.reshape(len(frames), -1, *frames.shape[1:3])


def pickle_content(episodes, form: str) -> list:
    """Returns what ROT pickles; the last frame of each episode is never seen by it."""
    columns: list[list] = [[], [], [], []]
    for frames, actions, rewards in episodes:
        columns[0].append(stacked(frames)[:-1])
        columns[1].append(np.zeros((len(actions), 5)))
        columns[2].append(actions)
        columns[3].append(np.append(0.0, rewards[:-1]))  # 0.0 comes with the reset
    if form == "arrays":
        return [np.array(column) for column in columns]
    if form == "lists of arrays":
        return columns
    if form == "lists of steps":
        columns[3] = [rewards.tolist() for rewards in columns[3]]
        return [*([list(steps) for steps in column] for column in columns)]
    ragged = [np.empty(len(column), object) for column in columns]
    for array, column in zip(ragged, columns, strict=True):
        array[:] = column
    return ragged


def drqv2_entries(frames, actions, rewards, num_frames=3) -> dict[str, np.ndarray]:
    """Returns the arrays that DrQ-v2's replay stores, zeros of the reset first."""
    return {
        "observation": stacked(frames, num_frames),
        "action": np.concatenate([np.zeros_like(actions[:1]), actions]),
        "reward": np.append(np.float32(0), rewards)[:, None],
        "discount": np.ones((len(frames), 1), np.float32),
    }


def dreamer_entries(frames, actions, rewards) -> dict[str, np.ndarray]:
    """Returns the arrays that DreamerV2's replay stores, zeros of the reset first."""
    times = np.arange(len(frames))
    return {
        "image": frames,
        "action": np.concatenate([np.zeros_like(actions[:1]), actions]),
        "reward": np.append(np.float32(0), rewards),
        "discount": np.ones(len(frames), np.float32),
        "is_first": times == 0,
        "is_last": times == len(actions),
        "is_terminal": times < 0,
    }


def write_own(path: pathlib.Path, seed: int) -> None:
    """jaxil's own file of pixels; only odd seeds have actions and rewards."""
    rng = np.random.default_rng(seed)
    episodes = [
        PixelEpisode(
            _random_frames(rng, num_steps + 1),
            rng.uniform(-1, 1, (num_steps, 2)).astype(np.float32) if seed % 2 else None,
            rng.uniform(size=num_steps).astype(np.float32) if seed % 2 else None,
        )
        for num_steps in (3, 5)
    ]
    recording = Recording("made up", len(episodes), iter(episodes), action_repeat=2)
    own.write_pixels(path, recording, origin="a test")
