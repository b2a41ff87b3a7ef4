"""LeRobot datasets: one of its own, others of known content, and hostile ones."""

import json
import pathlib
import sys

import numpy as np
import pytest

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import lerobot
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import (
    CAMERA,
    make_lerobot_dataset,
    make_parquet,
    read_here,
)

pytest.importorskip("pyarrow", reason="pyarrow writes and reads Parquet files")

REAL = pathlib.Path(__file__).parent / "data" / "lerobot_v3"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
DATA_FILE = "data/chunk-000/file-000.parquet"
VIDEO_FILE = f"videos/{CAMERA}/chunk-000/file-000.mp4"


def make_episode(num_frames, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "frames": rng.integers(0, 256, (num_frames, 8, 8, 3), dtype=np.uint8),
        "action": rng.uniform(-1, 1, (num_frames, 2)).astype(np.float32),
        "next.reward": rng.uniform(size=num_frames).astype(np.float32),
    }


EPISODES = [make_episode(3), make_episode(5, 1), make_episode(2, 2)]


def read(path, **options):
    return read_here(lerobot, path, **options)


def assert_same(episodes, expected):
    for episode, stored in zip(episodes, expected, strict=True):
        np.testing.assert_array_equal(episode.frames, stored["frames"])
        np.testing.assert_array_equal(episode.actions, stored["action"][:-1])
        np.testing.assert_array_equal(episode.rewards, stored["next.reward"][:-1])
        for array, kind in zip(episode, ("uint8", "float32", "float32"), strict=False):
            assert array.dtype == kind


@pytest.fixture(name="path")
def _path(tmp_path):
    make_lerobot_dataset(tmp_path / "dataset", EPISODES)
    return tmp_path / "dataset"


def set_info(path, **values):
    file = path / "meta" / "info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def change_rows(path, file, function):
    """Applies `function` to a Parquet file's rows, a list of dicts."""
    from pyarrow import parquet

    rows = parquet.read_table(path / file).to_pylist()
    make_parquet(path / file, function(rows) or rows)


# --- what is read ---------------------------------------------------------------------


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


# --- faults ---------------------------------------------------------------------------


def set_row(row, **values):
    """Returns a change of one row; "_" stands for "/" in names."""

    def function(rows):
        rows[row].update(
            {name.replace("__", "/"): value for name, value in values.items()}
        )

    return function


def without(name):
    return lambda rows: [
        {key: value for key, value in row.items() if key != name} for row in rows
    ]


TIME = f"videos/{CAMERA}/from_timestamp"
ROW_FAULTS = {
    "no column": (EPISODES_FILE, without("length"), "has no column length in file-000"),
    "an episode too few": (EPISODES_FILE, lambda rows: rows[:2], "has 2 episodes, not"),
    "an episode twice": (
        EPISODES_FILE,
        set_row(1, episode_index=0),
        "has 3 episodes, not",
    ),
    "words": (
        EPISODES_FILE,
        lambda rows: [{**row, "length": "many"} for row in rows],
        "has an episode with an invalid location",
    ),
    "fractions": (
        EPISODES_FILE,
        lambda rows: [{**row, "length": 2.5} for row in rows],
        "has an episode with an invalid location",
    ),
    "an absent number": (
        EPISODES_FILE,
        set_row(1, length=None),
        "has an episode with an invalid location",
    ),
    "an episode of one frame": (EPISODES_FILE, set_row(0, length=1), "has 1 frames in"),
    "a file that is not there": (
        EPISODES_FILE,
        set_row(0, data__chunk_index=7),
        None,
    ),
    "a negative time": (EPISODES_FILE, set_row(0, **{TIME: -1.0}), "invalid location"),
    "no time": (EPISODES_FILE, set_row(0, **{TIME: float("nan")}), "invalid location"),
    "overlapping": (
        EPISODES_FILE,
        set_row(1, **{TIME: 0.1}),
        "has an episode 1 that overlaps another",
    ),
    "behind the end": (
        EPISODES_FILE,
        set_row(1, **{TIME: 0.6}),
        "has a video that ends after 2 of the 5 frames of episode 1",
    ),
    "another length": (
        EPISODES_FILE,
        set_row(0, length=2),
        "does not have the 2 rows of episode 0 in file-000.parquet",
    ),
    "a frame twice": (DATA_FILE, set_row(1, frame_index=0), "does not have the"),
    "another episode": (DATA_FILE, set_row(0, episode_index=1), "does not have the"),
    "no rows": (DATA_FILE, lambda rows: rows[:3], "does not have the"),
    "no action": (
        DATA_FILE,
        set_row(1, action=None),
        "not numbers in action|unequal lengths",
    ),
    "a short action": (
        DATA_FILE,
        set_row(1, action=[1.0]),
        "unequal lengths in action",
    ),
    "an action of nothing": (
        DATA_FILE,
        set_row(1, action=[1.0, None]),
        "not numbers in",
    ),
}


@pytest.mark.parametrize("name", ROW_FAULTS)
def test_rows_that_break_the_rules_are_refused(path, name):
    file, function, message = ROW_FAULTS[name]
    change_rows(path, file, function)
    kind = FormatError if message else FileNotFoundError
    with pytest.raises(kind, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        ({"bytes": None, "path": "/etc/passwd"}, "does not store its images"),
        ({"bytes": b"\x89PNG\r\n\x1a\n", "path": ""}, "has a damaged image 0"),
        ({"path": "a.png"}, "does not store its images"),
        ("a.png", "does not store its images"),
    ],
)
def test_pictures_that_cannot_be_read_are_refused(tmp_path, picture, message):
    path = tmp_path / "dataset"
    make_lerobot_dataset(path, EPISODES, as_images=True)
    change_rows(
        path, DATA_FILE, lambda rows: [{**row, CAMERA: picture} for row in rows]
    )
    with pytest.raises(FormatError, match=message):
        read(path)


def feature(kind):
    return {"dtype": kind, "shape": [1]}


INFO_FAULTS = {
    "old": (
        {"codebase_version": "v2.1"},
        "codebase_version 'v2.1', not v3",
    ),
    "no version": ({"codebase_version": 3}, "codebase_version 3"),
    "no rate": ({"fps": 0}, "has fps=0"),
    "endless rate": ({"fps": float("inf")}, "has fps=inf"),
    "rate beyond numbers": ({"fps": 10**400}, "has fps=1000"),
    "rate in words": ({"fps": "10"}, "has fps='10'"),
    "another rate": ({"fps": 20}, "video file-000.mp4 of 10 frames per second, but"),
    "no episodes": ({"total_episodes": 0}, "has total_episodes=0"),
    "many episodes": ({"total_episodes": 10**9}, "has total_episodes=1000000000"),
    "no camera": ({"features": {"action": feature("float32")}}, "has 0 cameras"),
    "two cameras": (
        {"features": {"left": feature("video"), "right": feature("image")}},
        "has 2 cameras, not one: left, right",
    ),
    "no features": ({"features": [1]}, "has no features"),
    "broken feature": ({"features": {"action": 3}}, "has 0 cameras"),
    "no path": ({"data_path": None}, "has no data_path"),
    "upwards": (
        {"data_path": "data/../../x.parquet"},
        "refers to a file 'data/../../x",
    ),
    "absolute": ({"data_path": "/etc/passwd"}, "refers to a file '/etc/passwd' outs"),
    "empty": ({"video_path": ""}, "refers to a file ''"),
    "zero byte": ({"video_path": "a\0b"}, "outside its folder"),
    "half a letter": ({"data_path": "\ud800"}, "outside its folder"),
    "unreadable camera": (
        {"features": {"a\nb": feature("video")}},
        "has no column vid",
    ),
    "unreadable cameras": (
        {"features": {"\ud800": feature("video"), "b": feature("video")}},
        r"has 2 cameras, not one: \?, b",
    ),
    "camera as a path": (
        {
            "features": {"../../..": feature("video")},
            "video_path": "videos/{video_key}/x.mp4",
        },
        "has no column",
    ),
}


@pytest.mark.parametrize("name", INFO_FAULTS)
def test_information_that_does_not_fit_is_refused(path, name):
    values, message = INFO_FAULTS[name]
    set_info(path, **values)
    with pytest.raises(FormatError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)


def test_one_of_several_cameras_is_read_by_name(path):
    (before, *_) = read(path)[1]
    info = json.loads((path / "meta" / "info.json").read_text())
    set_info(path, features={**info["features"], "other": feature("video")})
    with pytest.raises(FormatError, match=r"demonstrations\.camera=NAME"):
        read(path)
    with pytest.raises(FormatError, match=r"has no camera 'third', but: .*other"):
        read(path, camera="third")
    (after, *_) = read(path, camera=CAMERA)[1]
    np.testing.assert_array_equal(after.frames, before.frames)


def test_a_camera_whose_name_leads_outside_is_refused(path):
    camera = "../../.."
    set_info(path, features={camera: feature("video")})
    change_rows(
        path,
        EPISODES_FILE,
        lambda rows: [
            {name.replace(CAMERA, camera): value for name, value in row.items()}
            for row in rows
        ],
    )
    with pytest.raises(
        FormatError, match=r"refers to a file 'videos/\.\./\.\./\.\./ch"
    ):
        read(path)


@pytest.mark.parametrize(
    "template",
    [
        "{chunk_index:99999999d}",
        "{chunk_index.__class__}",
        "{0}",
        "{",
        "{file_index!r}",
    ],
)
def test_templates_are_no_programs(path, template):
    set_info(path, data_path=template)
    with pytest.raises(
        (FormatError, FileNotFoundError),
        match=r"has data_path=|refers to a file|No such file",
    ):
        read(path)


@pytest.mark.parametrize(
    "name", [EPISODES_FILE, DATA_FILE, VIDEO_FILE, "meta/info.json"]
)
@pytest.mark.parametrize("folder", [False, True])
def test_links_that_lead_outside_are_refused(path, tmp_path, name, folder):
    place = (path / name).parent if folder else path / name
    outside = tmp_path / "outside"
    place.rename(outside)
    place.symlink_to(outside)
    with pytest.raises(FormatError, match="has a link that leaves its folder in"):
        read(path)
    place.unlink()
    place.symlink_to(place)  # to itself
    with pytest.raises((FormatError, OSError)):
        read(path)


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
    if as_images:
        limit *= 2
    assert_same(read(path, max_bytes=limit)[1], EPISODES)
    limit = 5 * 8 * 8 * 3 - 1
    with pytest.raises(FormatError, match=f"bytes.*, more than the {limit} "):
        read(path, max_bytes=limit)


def test_frames_of_videos_are_scaled_while_they_are_decoded(path):
    limit = 5 * 4 * 4 * 3  # of the longest episode
    _, episodes = read(path, max_bytes=1000, image_size=4)
    assert max(episode.frames.nbytes for episode in episodes) == limit
    assert episodes[0].stored_size == (8, 8)


@pytest.mark.parametrize("name", [EPISODES_FILE, DATA_FILE, VIDEO_FILE])
def test_a_file_cut_off_is_refused(path, name):
    content = (path / name).read_bytes()
    (path / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(FormatError, match="damaged"):
        list(foreign.open_recording(path, max_bytes=2**24).episodes)


def test_without_pyarrow_one_is_told_what_to_install(path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(FormatError, match=r"pyarrow: pip install pyarrow"):
        read(path)


@pytest.mark.parametrize("content", ["{", "[]", "[" * 10**5])
def test_information_that_is_no_json_is_refused(path, content):
    (path / "meta" / "info.json").write_text(content)
    with pytest.raises(FormatError, match=r"holds info.json, which"):
        read(path)


def test_folders_that_are_something_else(tmp_path):
    assert not lerobot.recognises(tmp_path)
    assert not lerobot.recognises(tmp_path / "none")
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    assert not lerobot.recognises(tmp_path)
