"""Minari datasets of known content, written by Minari itself."""

import json
import pathlib

import numpy as np


def minari_episode(num_steps, seed=0, size=8):
    rng = np.random.default_rng(seed)
    shape = (num_steps + 1, size, size, 3)
    return {
        "observations": rng.integers(0, 256, shape, dtype=np.uint8),
        "actions": rng.uniform(-1, 1, (num_steps, 2)).astype(np.float32),
        "rewards": rng.uniform(size=num_steps),
    }


EPISODES = [minari_episode(3), minari_episode(5, seed=1)]


def make_minari_dataset(
    path: pathlib.Path, episodes: list[dict], *, observation_space=None, **options
) -> pathlib.Path:
    """Writes a dataset by Minari; returns its path.

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
    return path


def set_metadata(path: pathlib.Path, **values) -> None:
    file = path / "data" / "metadata.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))
