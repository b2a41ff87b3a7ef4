"""Small valid files of each foreign format, as their own programs would write them."""

import pathlib
import pickle
import subprocess

import imageio_ffmpeg
import numpy as np


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
    write_minari_episodes(path, episodes)


def write_minari_episodes(
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
    encode_video(path, frames, "-f", "mp4", "-c:v", "libx264rgb", "-qp", "0")


def encode_video(
    path: pathlib.Path, frames: np.ndarray, *output: str, fps: float | str = 25
) -> None:
    """Writes frames [T, H, W, 3] by ffmpeg, with these options for its output."""
    height, width = frames.shape[1:3]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", str(fps), "-i", "-", *output, str(path)]
    subprocess.run(command, input=frames.tobytes(), check=True, capture_output=True)


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
