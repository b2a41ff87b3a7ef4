"""Tables that survive kills, and those that did not."""

import tracemalloc

import numpy as np
import pytest

from jaxil.files.tables import CsvLog, read_csv

COLUMNS = ("frame", "episode", "task_return")


def write_rows(path, frames, **options) -> None:
    log = CsvLog(path, COLUMNS, **options)
    for frame in frames:
        log.append({"frame": frame, "episode": frame // 10, "task_return": frame / 3})


def test_rows_are_in_the_file_at_once(tmp_path):
    log = CsvLog(tmp_path / "log.csv", COLUMNS)
    log.append({"frame": 10, "task_return": np.float32(0.1)})

    assert (tmp_path / "log.csv").read_text() == "frame,episode,task_return\n10,,0.1\n"


def test_numbers_come_back_exactly(tmp_path):
    values = [1 / 3, 1e-300, -0.0, np.inf, np.nextafter(1.0, 2.0)]
    log = CsvLog(tmp_path / "log.csv", COLUMNS)
    for frame, value in enumerate(values):
        log.append({"frame": np.int64(frame), "task_return": value})

    table = read_csv(tmp_path / "log.csv")

    np.testing.assert_array_equal(table["task_return"], values)
    np.testing.assert_array_equal(table["frame"], range(5))
    assert np.isnan(table["episode"]).all()


def test_a_resumed_table_is_the_same_as_an_unbroken_one(tmp_path):
    write_rows(tmp_path / "unbroken.csv", [10, 20, 30, 40])
    # Rows 30 and 40 were written after the checkpoint of frame 20.
    write_rows(tmp_path / "broken.csv", [10, 20, 30, 40])
    write_rows(tmp_path / "broken.csv", [30, 40], resume_frame=20)

    assert (tmp_path / "broken.csv").read_bytes() == (
        tmp_path / "unbroken.csv"
    ).read_bytes()


def test_a_row_cut_off_by_a_kill_is_dropped(tmp_path):
    path = tmp_path / "log.csv"
    write_rows(path, [10, 20])
    with path.open("a") as file:
        # Of 1.5e10, say: without its line end it cannot be trusted.
        file.write("30,3,1")

    np.testing.assert_array_equal(read_csv(path)["frame"], [10, 20])
    write_rows(path, [40], resume_frame=1000)
    np.testing.assert_array_equal(read_csv(path)["frame"], [10, 20, 40])


def test_a_long_table_from_elsewhere_takes_little_memory(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("frame,a\n" + "1,1\n" * 300_000)
    tracemalloc.start()
    assert len(read_csv(path)["a"]) == 300_000
    assert tracemalloc.get_traced_memory()[1] < 40e6
    tracemalloc.stop()
    with path.open("a") as file:
        file.truncate(2**26 + 1)
    with pytest.raises(ValueError, match="at most"):
        read_csv(path)


def test_without_a_frame_to_resume_from_the_table_begins_anew(tmp_path):
    write_rows(tmp_path / "log.csv", [10, 20])
    write_rows(tmp_path / "log.csv", [5])

    np.testing.assert_array_equal(read_csv(tmp_path / "log.csv")["frame"], [5])


def test_a_long_table_without_a_checkpoint_is_kept(tmp_path):
    """Someone has deleted the checkpoints of hours of training."""
    said = []
    for _ in range(2):
        write_rows(tmp_path / "log.csv", [10, 20], kept_from=5, say=said.append)
    assert said == ["no checkpoint: the former log.csv is kept as log.csv.old"]
    np.testing.assert_array_equal(read_csv(tmp_path / "log.csv.old")["frame"], [10, 20])
    # Killed after its last row, before the checkpoint that was due.
    write_rows(tmp_path / "log.csv", [10], kept_from=20, say=said.append)
    assert len(said) == 1
    assert len(list(tmp_path.iterdir())) == 2


def test_columns_may_change_between_versions(tmp_path):
    path = tmp_path / "log.csv"
    write_rows(path, [10])
    log = CsvLog(path, ("frame", "task_return", "added"), resume_frame=10)
    log.append({"frame": 20, "added": 7})

    table = read_csv(path)

    assert list(table) == ["frame", "task_return", "added"]
    np.testing.assert_array_equal(table["added"], [np.nan, 7])


def test_wrong_columns_are_named(tmp_path):
    log = CsvLog(tmp_path / "log.csv", COLUMNS)
    with pytest.raises(
        ValueError, match=r"log\.csv has no column losss: expected frame"
    ):
        log.append({"frame": 1, "losss": 2})
    assert (tmp_path / "log.csv").read_text() == "frame,episode,task_return\n"


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "frame,x\n1,one\n"])
def test_a_file_that_is_no_table_is_refused(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)

    with pytest.raises(ValueError, match=r"log\.csv: expected"):
        read_csv(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"frame,epi",
        b"frame,episode,task_return\n10,1\n20,2,3\n",
        b"frame,episode,task_return\nten,1,2\n",
        b"frame,episode,task_return\n10,\xff\xfe,2\n",
        b"frame,episode,task_return\n10,1," + b"9" * 200_000 + b"\n",
        b"\0" * 100 + b"\n",
    ],
    ids=["empty", "cut", "short row", "no number", "not UTF-8", "huge cell", "zeros"],
)
def test_a_damaged_table_is_set_aside_and_a_new_one_begun(tmp_path, content):
    path, said = tmp_path / "train.csv", []
    for again in ("", "2"):
        path.write_bytes(content)
        write_rows(path, [30], resume_frame=20, say=said.append)
        np.testing.assert_array_equal(read_csv(path)["frame"], [30])
        aside = tmp_path / f"train.csv.damaged{again}"
        assert aside.read_bytes() == content
        assert f"kept as {aside.name}" in said.pop()
    assert said == []


def test_a_folder_in_place_of_a_table_is_set_aside(tmp_path):
    (tmp_path / "train.csv").mkdir()
    said = []
    write_rows(tmp_path / "train.csv", [30], resume_frame=20, say=said.append)
    assert (tmp_path / "train.csv.damaged").is_dir()
    assert len(said) == 1


def test_a_table_that_was_deleted_is_not_begun_again_without_a_header(tmp_path):
    log = CsvLog(tmp_path / "log.csv", COLUMNS)
    (tmp_path / "log.csv").unlink()
    with pytest.raises(FileNotFoundError):
        log.append({"frame": 1})
