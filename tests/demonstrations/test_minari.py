"""Minari datasets written by Minari itself."""

import functools
import gc
import json
import warnings

import numpy as np
import pytest

from jaxil.demonstrations.readers import minari
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import read_here
from tests.demonstrations.minari_datasets import (
    EPISODES,
    make_minari_dataset,
    minari_episode,
    set_metadata,
)

pytest.importorskip("minari", reason="Minari writes the datasets of these tests")
gymnasium = pytest.importorskip("gymnasium")
h5py = pytest.importorskip("h5py")


read = functools.partial(read_here, minari)


@pytest.fixture(name="path")
def _path(tmp_path):
    return make_minari_dataset(tmp_path / "dataset", EPISODES)


@pytest.mark.parametrize("inner", ["", "data"])
def test_what_minari_writes_is_read(path, inner):
    assert minari.recognises(path / inner)
    recording, episodes = read(path / inner)
    assert recording.num_episodes == len(episodes) == 2
    assert recording.task is None
    assert recording.notes == ()
    for episode, expected in zip(episodes, EPISODES, strict=True):
        np.testing.assert_array_equal(episode.frames, expected["observations"])
        np.testing.assert_array_equal(episode.actions, expected["actions"])
        rewards = expected["rewards"].astype(np.float32)
        np.testing.assert_array_equal(episode.rewards, rewards)
        for array, kind in zip(episode, ("uint8", "float32", "float32"), strict=False):
            assert array is not None
            assert array.dtype == kind


def test_what_an_environment_did_is_read(tmp_path, monkeypatch):
    """The collector of Minari, on an environment that counts."""
    from minari import DataCollector

    class Counter(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, (4, 4, 3), np.uint8)
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

        def picture(self):
            return np.full((4, 4, 3), 10 * self.time, np.uint8)

        def reset(self, *, seed=None, options=None):
            self.time = 0
            return self.picture(), {}

        def step(self, action):
            self.time += 1
            return self.picture(), float(self.time), self.time == 4, False, {}

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    environment = DataCollector(Counter())
    for episode in range(2):
        environment.reset()
        for time in range(4):
            environment.step(np.array([time / 8 + episode / 2], np.float32))
    with warnings.catch_warnings():
        # That nobody signed it, and that Minari leaves a folder to be cleaned up.
        warnings.simplefilter("ignore")
        environment.create_dataset("counting-v0")
        del environment
        gc.collect()
    _, episodes = read(tmp_path / "counting-v0")
    assert len(episodes) == 2
    for index, episode in enumerate(episodes):
        assert episode.frames[:, 0, 0, 0].tolist() == [0, 10, 20, 30, 40]
        assert episode.actions is not None
        expected = [time / 8 + index / 2 for time in range(4)]
        assert episode.actions[:, 0].tolist() == expected
        assert episode.rewards is not None
        assert episode.rewards.tolist() == [1, 2, 3, 4]


def test_episodes_are_in_the_order_of_their_numbers(tmp_path):
    many = [minari_episode(1, seed) for seed in range(11)]
    make_minari_dataset(tmp_path / "many", many)
    for episode, expected in zip(read(tmp_path / "many")[1], many, strict=True):
        np.testing.assert_array_equal(episode.frames, expected["observations"])


@pytest.mark.parametrize("kind", ["equal", "unequal"])
def test_jpegs_are_read_with_a_note(tmp_path, kind):
    rng = np.random.default_rng(0)
    episode = minari_episode(3, size=32)
    # One colour for each image; noise of a few grey levels makes lengths unequal.
    colours = rng.integers(50, 200, (4, 1, 1, 3))
    noise = rng.integers(0, 9, (4, 32, 32, 1)) * np.arange(4)[:, None, None, None]
    images = colours + (noise if kind == "unequal" else 0)
    if kind == "equal":
        images = np.broadcast_to(images[:1], (4, 32, 32, 3))
    episode["observations"] = images.astype(np.uint8)
    make_minari_dataset(tmp_path / "jpeg", [episode])
    with h5py.File(tmp_path / "jpeg" / "data" / "main_data.hdf5") as file:
        assert file["episode_0/observations"].ndim == (2 if kind == "equal" else 1)
    recording, (seen,) = read(tmp_path / "jpeg")
    assert "JPEG" in recording.notes[0]
    assert seen.frames.shape == (4, 32, 32, 3)
    difference = seen.frames.astype(int) - images
    assert np.abs(difference.mean(axis=(1, 2))).max() < 4
    # Without JPEG, nothing is lost.
    make_minari_dataset(tmp_path / "raw", [episode], jpeg_encoding=False)
    recording, (seen,) = read(tmp_path / "raw")
    assert recording.notes == ()
    np.testing.assert_array_equal(seen.frames, images)


def with_dictionary(*images, num_steps=3):
    episode = minari_episode(num_steps)
    space = {name: gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8) for name in images}
    space["speed"] = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    observations = dict.fromkeys(images, episode["observations"])
    observations["speed"] = np.zeros((num_steps + 1, 3), np.float32)
    return {**episode, "observations": observations}, gymnasium.spaces.Dict(space)


def test_the_one_image_of_a_dictionary_is_taken(tmp_path):
    episode, space = with_dictionary("camera")
    make_minari_dataset(tmp_path / "a", [episode], observation_space=space)
    expected = episode["observations"]["camera"]
    np.testing.assert_array_equal(read(tmp_path / "a")[1][0].frames, expected)
    # One level further down.
    nested = {**episode, "observations": {"eyes": episode["observations"]}}
    space = gymnasium.spaces.Dict({"eyes": space})
    make_minari_dataset(tmp_path / "b", [nested], observation_space=space)
    np.testing.assert_array_equal(read(tmp_path / "b")[1][0].frames, expected)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (("left", "right"), "has 2 images.* not one: .*/left of .*/right of"),
        ((), r"has 0 images.* not one: .*speed of float32 \(4, 3\)"),
    ],
)
def test_dictionaries_without_one_image_are_refused(tmp_path, images, message):
    episode, space = with_dictionary(*images)
    make_minari_dataset(tmp_path / "a", [episode], observation_space=space)
    with pytest.raises(FormatError, match=message):
        read(tmp_path / "a")


def test_discrete_actions_are_left_out_with_a_note(tmp_path):
    episode = {**minari_episode(3), "actions": np.array([1, 0, 2])}
    make_minari_dataset(tmp_path / "a", [episode])
    recording, (seen,) = read(tmp_path / "a")
    assert seen.actions is None
    assert "actions" in recording.notes[0]


@pytest.mark.parametrize(
    ("name", "task"),
    [
        ("dm_control/ball_in_cup-catch-v0", "ball_in_cup_catch"),
        ("CartPole-v1", None),
        (["dm_control/a-b-v0"], None),
    ],
)
def test_the_task_is_known_where_it_is_one_of_dm_control(path, name, task):
    set_metadata(path, env_spec=json.dumps({"id": name}))
    assert read(path)[0].task == task


def test_older_datasets_have_no_metadata(path):
    (path / "data" / "metadata.json").unlink()
    assert minari.recognises(path)
    assert read(path)[0].num_episodes == 2
