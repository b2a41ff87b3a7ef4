"""LeRobot datasets: one that it wrote itself, and others of known content."""

import functools
import json
import pathlib

import numpy as np
import pytest

from jaxil.demonstrations.readers import lerobot
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import read_here
from tests.demonstrations.lerobot_datasets import (
    CAMERA,
    DATA_FILE,
    EPISODES,
    make_lerobot_dataset,
    set_info,
)

pytest.importorskip("pyarrow", reason="pyarrow writes and reads Parquet files")

REAL = pathlib.Path(__file__).parent / "data" / "lerobot_v3"


read = functools.partial(read_here, lerobot)


def assert_same(episodes, expected):
    for episode, stored in zip(episodes, expected, strict=True):
        np.testing.assert_array_equal(episode.frames, stored["frames"])
        np.testing.assert_array_equal(episode.actions, stored["action"][:-1])
        np.testing.assert_array_equal(episode.rewards, stored["next.reward"][:-1])
        for array, kind in zip(episode, ("uint8", "float32", "float32"), strict=False):
            assert array.dtype == kind


@pytest.fixture(name="path")
def _path(tmp_path):
    return make_lerobot_dataset(tmp_path / "dataset", EPISODES)


def test_what_lerobot_writes_is_read():
    assert lerobot.recognises(REAL)
    recording, episodes = read(REAL)
    assert recording.num_episodes == 2
    assert recording.frames_per_second == 10
    assert recording.notes == ()
    for index, (episode, length) in enumerate(zip(episodes, (4, 6), strict=True)):
        times = np.arange(length)
        levels = (40 * index + 20 * times)[:, None, None, None]
        assert episode.frames.shape == (length, 16, 16, 3)
        # The codec may be off by a few grey levels.
        np.testing.assert_allclose(episode.frames.astype(int) - levels, 0, atol=3)
        # What was done last led to no frame.
        actions = np.stack([times[:-1], np.full(length - 1, -index)], axis=1)
        np.testing.assert_array_equal(episode.actions, actions)
        np.testing.assert_array_equal(episode.rewards, times[:-1] / 8)


@pytest.mark.parametrize("as_images", [False, True])
def test_frames_actions_and_rewards_are_those_that_were_written(tmp_path, as_images):
    path = tmp_path / "dataset"
    make_lerobot_dataset(path, EPISODES, as_images=as_images, per_file=3)
    assert lerobot.recognises(path)
    assert_same(read(path)[1], EPISODES)


@pytest.mark.parametrize("as_images", [False, True])
@pytest.mark.parametrize("per_file", [1, 2])
@pytest.mark.parametrize("gap", [0, 2])
def test_episodes_are_found_in_their_files(tmp_path, as_images, per_file, gap):
    options = {"as_images": as_images, "per_file": per_file, "gap": gap}
    make_lerobot_dataset(tmp_path / "dataset", EPISODES, **options)
    assert_same(read(tmp_path / "dataset")[1], EPISODES)


def test_which_columns_are_actions_and_rewards(tmp_path):
    base = {"frames": EPISODES[0]["frames"]}
    numbers = np.array([0.5, 0.25, 0.125], np.float32)
    cases = {
        "none": ({}, None, None),
        "one number": ({"action": numbers}, [[0.5], [0.25]], None),
        "reward": ({"reward": numbers}, None, [0.5, 0.25]),
        "both": ({"reward": numbers, "next.reward": 2 * numbers}, None, [1, 0.5]),
        "discrete": ({"action": np.array([0, 1, 2])}, None, None),
    }
    for name, (columns, actions, rewards) in cases.items():
        make_lerobot_dataset(tmp_path / name, [{**base, **columns}])
        recording, (episode,) = read(tmp_path / name)
        for array, expected in ((episode.actions, actions), (episode.rewards, rewards)):
            assert (array is None) == (expected is None), name
            if array is not None:
                assert array.tolist() == expected, name
        assert len(recording.notes) == (actions is None), name


def test_one_of_several_cameras_is_read_by_name(path):
    (before, *_) = read(path)[1]
    features = json.loads((path / "meta" / "info.json").read_text())["features"]
    set_info(path, features={**features, "other": {"dtype": "video", "shape": [1]}})
    with pytest.raises(FormatError, match=r"demonstrations\.camera=NAME"):
        read(path)
    with pytest.raises(FormatError, match=r"has no camera 'third', but: .*other"):
        read(path, camera="third")
    (after, *_) = read(path, camera=CAMERA)[1]
    np.testing.assert_array_equal(after.frames, before.frames)


def test_links_within_the_folder_are_followed(path):
    (path / DATA_FILE).rename(path / "data" / "moved.parquet")
    (path / DATA_FILE).symlink_to(pathlib.Path("..") / "moved.parquet")
    link = path.with_name("link")
    link.symlink_to(path)
    assert_same(read(link)[1], EPISODES)


@pytest.mark.parametrize("as_images", [False, True])
def test_more_than_the_limit_is_refused_and_the_limit_itself_is_not(
    tmp_path, as_images
):
    path = tmp_path / "dataset"
    make_lerobot_dataset(path, EPISODES, as_images=as_images)
    limit = 5 * 8 * 8 * 3  # of the longest episode; PNGs of noise are larger
    enough = 2 * limit if as_images else limit
    assert_same(read(path, max_bytes=enough)[1], EPISODES)
    limit -= 1
    too_many = f"bytes.*, more than the {limit} "
    with pytest.raises(FormatError, match=too_many) as caught:
        read(path, max_bytes=limit)
    assert "frame_skip" not in str(caught.value)  # frames are skipped after that


def test_frames_of_videos_are_scaled_while_they_are_decoded(path):
    limit = 5 * 4 * 4 * 3  # of the longest episode
    _, episodes = read(path, max_bytes=1000, image_size=4)
    assert max(episode.frames.nbytes for episode in episodes) == limit
    assert episodes[0].stored_size == (8, 8)


def test_folders_that_are_something_else(tmp_path):
    assert not lerobot.recognises(tmp_path)
    assert not lerobot.recognises(tmp_path / "none")
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    assert not lerobot.recognises(tmp_path)
