"""Small valid files of each foreign format, as their own programs would write them."""

import pathlib
import pickle
import struct
from typing import Any

import numpy as np
from PIL import Image

from jaxil.demonstrations.readers import own
from jaxil.demonstrations.readers.recording import (
    PixelEpisode,
    ReadOptions,
    Recording,
    checked,
)
from tests.demonstrations.lerobot_datasets import lerobot_episode, make_lerobot_dataset
from tests.demonstrations.minari_datasets import make_minari_dataset, minari_episode
from tests.demonstrations.videos import encode_video


def write_lerobot(path: pathlib.Path, seed: int) -> None:
    """A LeRobot dataset of version 3, with a lossless video."""
    make_lerobot_dataset(path, [lerobot_episode(3, seed), lerobot_episode(5, seed + 1)])


def write_minari(path: pathlib.Path, seed: int) -> None:
    """A Minari dataset, whose frames are too small for it to store as JPEGs."""
    make_minari_dataset(path, [minari_episode(3, seed), minari_episode(4, seed + 1)])


def write_video(path: pathlib.Path, seed: int) -> None:
    """A lossless MP4 file of one episode."""
    frames = _random_frames(np.random.default_rng(seed), num_frames=5)
    encode_video(path, frames, format="mp4")


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
    """Two episodes as ROT writes them; the seed also picks form and protocol."""
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


def python2_pickle(array: np.ndarray) -> bytes:
    """Returns the opcodes with which Python 2 pickled a uint8 array [K, T, ...].

    Worked out from its `cPickle` and `pickletools.dis`; its strings are bytes.
    """
    data = array.tobytes()
    return b"".join(
        [
            b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n",
            b"K\0\x85U\1b\x87R(K\1(" + bytes(x for n in array.shape for x in (75, n)),
            b"tcnumpy\ndtype\nU\2u1K\0K\1\x87R(K\3U\1|NNNJ\xff\xff\xff\xff",
            b"J\xff\xff\xff\xffK\0tb\x89T"
            + struct.pack("<i", len(data))
            + data
            + b"tb",
        ]
    )


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
