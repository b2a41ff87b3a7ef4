"""LeRobot datasets that break the rules or mislead."""

import functools
import sys

import pytest

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import lerobot
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import read_here
from tests.demonstrations.lerobot_datasets import (
    CAMERA,
    DATA_FILE,
    EPISODES,
    INDEX_FILE,
    VIDEO_FILE,
    make_lerobot_dataset,
    make_parquet,
    set_info,
)

pytest.importorskip("pyarrow", reason="pyarrow writes and reads Parquet files")

read = functools.partial(read_here, lerobot)


@pytest.fixture(name="path")
def _path(tmp_path):
    return make_lerobot_dataset(tmp_path / "dataset", EPISODES)


def change_rows(path, file, function):
    """Applies `function` to a Parquet file's rows, a list of dicts."""
    from pyarrow import parquet

    rows = parquet.read_table(path / file).to_pylist()
    make_parquet(path / file, function(rows) or rows)


def set_row(row, **values):
    return lambda rows: rows[row].update(values)


def set_rows(**values):
    return lambda rows: [{**row, **values} for row in rows]


def without(name):
    return lambda rows: [
        {key: value for key, value in row.items() if key != name} for row in rows
    ]


TIME = f"videos/{CAMERA}/from_timestamp"
NOWHERE = "has an episode with an invalid location"
ROW_FAULTS = {
    "no column": (INDEX_FILE, without("length"), "has no column length in file-000"),
    "an episode too few": (INDEX_FILE, lambda rows: rows[:2], "has 2 episodes, not"),
    "an episode twice": (INDEX_FILE, set_row(1, episode_index=0), "has 3 episodes"),
    "words": (INDEX_FILE, set_rows(length="many"), NOWHERE),
    "fractions": (INDEX_FILE, set_rows(length=2.5), NOWHERE),
    "an absent number": (INDEX_FILE, set_row(1, length=None), NOWHERE),
    "an episode of one frame": (INDEX_FILE, set_row(0, length=1), "has 1 frames in"),
    "a file that is not there": (
        INDEX_FILE,
        set_row(0, **{"data/chunk_index": 7}),
        None,
    ),
    "a negative time": (INDEX_FILE, set_row(0, **{TIME: -1.0}), NOWHERE),
    "no time": (INDEX_FILE, set_row(0, **{TIME: float("nan")}), NOWHERE),
    "overlapping": (
        INDEX_FILE,
        set_row(1, **{TIME: 0.1}),
        "has an episode 1 that overlaps another",
    ),
    "behind the end": (
        INDEX_FILE,
        set_row(1, **{TIME: 0.6}),
        "has a video that ends after 2 of the 5 frames of episode 1",
    ),
    "another length": (
        INDEX_FILE,
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
    "a short action": (DATA_FILE, set_row(1, action=[1.0]), "unequal lengths in"),
    "an action of nothing": (DATA_FILE, set_row(1, action=[1.0, None]), "not numbers"),
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
    change_rows(path, DATA_FILE, set_rows(**{CAMERA: picture}))
    with pytest.raises(FormatError, match=message):
        read(path)


def feature(kind):
    return {"dtype": kind, "shape": [1]}


INFO_FAULTS = {
    "old": ({"codebase_version": "v2.1"}, "codebase_version 'v2.1', not v3"),
    "no version": ({"codebase_version": 3}, "codebase_version 3"),
    "no rate": ({"fps": 0}, "has fps=0"),
    "hardly any rate": ({"fps": 5e-324}, "has fps=5e-324"),
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


def test_a_camera_whose_name_leads_outside_is_refused(path):
    camera = "../../.."
    set_info(path, features={camera: feature("video")})

    def rename(rows):
        return [{k.replace(CAMERA, camera): v for k, v in row.items()} for row in rows]

    change_rows(path, INDEX_FILE, rename)
    message = r"refers to a file 'videos/\.\./\.\./\.\./ch"
    with pytest.raises(FormatError, match=message):
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


@pytest.mark.parametrize("name", [INDEX_FILE, DATA_FILE, VIDEO_FILE, "meta/info.json"])
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


@pytest.mark.parametrize("name", [INDEX_FILE, DATA_FILE, VIDEO_FILE])
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
