"""Files that are replaced as a whole."""

import os
import time

import pytest

from jaxil.files.writing import obstacle, remove_leftovers, replacing, write_atomically


def test_a_failed_replacement_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, b"new")

    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_folders_and_long_names_are_replaced_too(tmp_path):
    with replacing(tmp_path / "folder") as temporary:
        (temporary / "inner").mkdir(parents=True)
        assert not (tmp_path / "folder").exists()
    assert (tmp_path / "folder" / "inner").is_dir()
    long = tmp_path / ("x" * 251 + ".mp4")
    with replacing(long) as temporary:
        assert temporary.suffix == ".mp4"
        temporary.write_bytes(b"video")
    assert long.read_bytes() == b"video"


@pytest.mark.parametrize("inside", ["", "a", "a/b"])
def test_a_folder_that_need_not_exist_can_be_written(inside, tmp_path):
    assert obstacle(tmp_path / inside) is None
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_the_way_of_a_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    for inside in ("file", "file/a"):
        assert obstacle(tmp_path / inside) == f"{tmp_path}/file: Not a directory"
    assert str(obstacle("/proc/a/b")).startswith("/proc: ")


def test_what_killed_processes_left_is_removed(tmp_path):
    left = [
        ".tmp-0123456789ab-eval.csv",
        ".tmp-0123456789ab-frame_000001000.mp4",
    ]
    kept = ["config.json", "eval.csv", ".DS_Store", "notes.tmp"]
    for name in (*left, *kept):
        (tmp_path / name).write_text("")
    (tmp_path / ".deleting_frame_000000001000" / "learner").mkdir(parents=True)

    remove_leftovers(tmp_path, min_age_seconds=60.0)
    assert len(list(tmp_path.iterdir())) == 7  # others may be writing them now
    for path in tmp_path.iterdir():
        before = time.time() - 61
        os.utime(path, (before, before))
    remove_leftovers(tmp_path, min_age_seconds=60.0)

    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)
    remove_leftovers(tmp_path / "missing")
