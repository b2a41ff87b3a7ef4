"""LeRobot datasets of known content, written as it documents version 3."""

import io
import json
import pathlib

import numpy as np
from PIL import Image

from tests.demonstrations.videos import encode_video

CAMERA = "observation.images.front"  # in the datasets of LeRobot
INDEX_FILE = "meta/episodes/chunk-000/file-000.parquet"
DATA_FILE = "data/chunk-000/file-000.parquet"
VIDEO_FILE = f"videos/{CAMERA}/chunk-000/file-000.mp4"


def lerobot_episode(num_frames, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "frames": rng.integers(0, 256, (num_frames, 8, 8, 3), dtype=np.uint8),
        "action": rng.uniform(-1, 1, (num_frames, 2)).astype(np.float32),
        "next.reward": rng.uniform(size=num_frames).astype(np.float32),
    }


EPISODES = [lerobot_episode(3), lerobot_episode(5, 1), lerobot_episode(2, 2)]


def make_lerobot_dataset(
    path: pathlib.Path,
    episodes: list[dict],
    *,
    as_images=False,
    per_file=2,
    gap=0,
    **info,
) -> pathlib.Path:
    """Writes a dataset as LeRobot documents version 3; returns its path.

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
    make_parquet(path / INDEX_FILE, rows)
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
    return path


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


def set_info(path, **values):
    file = path / "meta" / "info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))
