"""Tables that survive kills, the learning curve and the live line."""

import io

import matplotlib.image
import numpy as np
import pytest

from jaxil.files.metrics import (
    EVAL_COLUMNS,
    CsvLog,
    Metrics,
    read_csv,
    write_atomically,
    write_learning_curve,
)
from jaxil.machine.progress import ProgressLine, duration

COLUMNS = ("frame", "episode", "task_return")


def write_rows(path, frames, **options) -> None:
    log = CsvLog(path, COLUMNS, **options)
    for frame in frames:
        log.append({"frame": frame, "episode": frame // 10, "task_return": frame / 3})
    log.close()


def test_rows_are_in_the_file_at_once(tmp_path):
    log = CsvLog(tmp_path / "log.csv", COLUMNS)
    log.append({"frame": 10, "task_return": np.float32(0.1)})

    assert (tmp_path / "log.csv").read_text() == "frame,episode,task_return\n10,,0.1\n"
    log.close()


def test_numbers_come_back_exactly(tmp_path):
    values = [1 / 3, 1e-300, -0.0, np.inf, np.nextafter(1.0, 2.0)]
    log = CsvLog(tmp_path / "log.csv", COLUMNS)
    for frame, value in enumerate(values):
        log.append({"frame": np.int64(frame), "task_return": value})
    log.close()

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
        file.write(
            "30,3,1"
        )  # of 1.5e10, say: without its line end it cannot be trusted

    np.testing.assert_array_equal(read_csv(path)["frame"], [10, 20])
    write_rows(path, [40], resume_frame=1000)
    np.testing.assert_array_equal(read_csv(path)["frame"], [10, 20, 40])


def test_without_a_frame_to_resume_from_the_table_begins_anew(tmp_path):
    write_rows(tmp_path / "log.csv", [10, 20])
    write_rows(tmp_path / "log.csv", [5])

    np.testing.assert_array_equal(read_csv(tmp_path / "log.csv")["frame"], [5])


def test_columns_may_change_between_versions(tmp_path):
    path = tmp_path / "log.csv"
    write_rows(path, [10])
    log = CsvLog(path, ("frame", "task_return", "added"), resume_frame=10)
    log.append({"frame": 20, "added": 7})
    log.close()

    table = read_csv(path)

    assert list(table) == ["frame", "task_return", "added"]
    np.testing.assert_array_equal(table["added"], [np.nan, 7])


def test_wrong_columns_are_named(tmp_path):
    with pytest.raises(ValueError, match='expected "frame"'):
        CsvLog(tmp_path / "log.csv", ("episode",))
    log = CsvLog(tmp_path / "log.csv", COLUMNS)
    with pytest.raises(
        ValueError, match=r"log\.csv has no column losss: expected frame"
    ):
        log.append({"frame": 1, "losss": 2})
    log.close()
    assert (tmp_path / "log.csv").read_text() == "frame,episode,task_return\n"


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "frame,x\n1,one\n"])
def test_a_file_that_is_no_table_is_refused(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)

    with pytest.raises(ValueError, match=r"log\.csv: expected"):
        read_csv(path)


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


def test_metrics_write_tables_and_events(tmp_path):
    metrics = Metrics(tmp_path, extra_eval_columns=["actor_pre_tanh"])
    metrics.train({"frame": 1000, "episode": 1, "task_return": 12.5, "length": 500})
    metrics.evaluation({"frame": 1000, "task_return_mean": 20, "actor_pre_tanh": 1})
    metrics.scalars(1000, {"losses/critic": np.float32(0.25)})
    metrics.close()

    assert read_csv(tmp_path / "train.csv")["task_return"] == [12.5]
    evaluations = read_csv(tmp_path / "eval.csv")
    assert list(evaluations) == [*EVAL_COLUMNS, "actor_pre_tanh"]
    (events,) = (tmp_path / "tensorboard").iterdir()
    content = events.read_bytes()
    for tag in (b"train/task_return", b"eval/task_return_mean", b"losses/critic"):
        assert tag in content


@pytest.mark.parametrize("num_rows", [0, 1, 30])
def test_the_learning_curve_is_a_picture(tmp_path, num_rows):
    log = CsvLog(tmp_path / "eval.csv", EVAL_COLUMNS)
    for row in range(1, num_rows + 1):
        mean = 700 * (1 - np.exp(-row / 8))
        log.append(
            {
                "frame": 10_000 * row,
                "task_return_mean": mean,
                "task_return_std": mean / 9,
            }
        )
    log.close()

    write_learning_curve(
        tmp_path / "curve.png",
        tmp_path / "eval.csv",
        title="P-DAC, cartpole_swingup",
        expert_return=858.0,
    )

    picture = matplotlib.image.imread(tmp_path / "curve.png")
    assert picture.shape[:2] == (570, 960)
    # The agent's line is the only thing in this colour.
    distance = np.abs(picture[..., :3] - np.array([0x1F, 0x6F, 0x8B]) / 255).max(
        axis=-1
    )
    drawn = int((distance < 0.02).sum())
    assert drawn > 30 if num_rows else drawn == 0


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def make_clock(times):
    remaining = iter(times)
    return lambda: next(remaining)


def test_the_live_line_by_hand():
    stream = Terminal()
    line = ProgressLine(10_000, stream=stream, clock=make_clock([0.0, 10.0]))

    line.update(
        1000,
        {"environment": 2.0, "update": 7.5},
        {"task": 12.34},
        note="checkpoint at 500",
    )

    # 1000 frames in 10 s; 2, 7.5 and 0.5 s of the 10; 9000 frames left at 100 a second.
    assert stream.getvalue() == (
        "\r1000/10000 frames (10.0 %) | 100 frames/s"
        " | environment 20% update 75% rest 5% | return task 12.3"
        " | 2 min left | checkpoint at 500"
    )


def test_a_shorter_line_wipes_the_longer_one():
    stream = Terminal()
    line = ProgressLine(100, stream=stream, clock=make_clock([0, 1, 2]))
    line.update(10, {}, note="x" * 30)
    line.update(20, {})
    line.message("saved")
    line.close()

    first, second, third = stream.getvalue().split("\r")[1:]
    assert len(second) == len(first)
    assert third.rstrip() == "saved"
    assert third.endswith("\n")


def test_a_terminal_is_not_redrawn_at_every_step():
    stream = Terminal()
    line = ProgressLine(100, stream=stream, clock=make_clock([0, 1, 1.05, 1.1, 1.3]))
    for frame in range(1, 5):
        line.update(frame, {})

    assert stream.getvalue().count("\r") == 2


def test_a_log_file_gets_a_line_every_30_seconds():
    stream = io.StringIO()
    line = ProgressLine(10_000, stream=stream, clock=make_clock(range(201)))
    for frame in range(200):
        line.update(frame, {})

    lines = stream.getvalue().splitlines()
    assert len(lines) == 7  # after 3, 33, ... 183 seconds
    assert "\r" not in stream.getvalue()


def test_speed_follows_a_change():
    stream = io.StringIO()
    line = ProgressLine(10**6, stream=stream, clock=make_clock(range(602)))
    frame = 0
    for second in range(600):
        frame += 10 if second < 300 else 50
        line.update(frame, {"update": float(second)})

    assert "| 50 frames/s | update 100% rest 0%" in stream.getvalue().splitlines()[-1]


def test_speed_after_a_resume_counts_this_process_only():
    stream = Terminal()
    clock = make_clock([0.0, 10.0])
    line = ProgressLine(10_000, first_frame=5000, stream=stream, clock=clock)
    line.update(5100, {})

    assert "| 10 frames/s | 8 min left" in stream.getvalue()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min"),
        (3569, "59 min"),
        (3590, "1 h 00 min"),
        (11_100, "3 h 05 min"),
        (187_200, "2 d 04 h"),
    ],
)
def test_durations(seconds, text):
    assert duration(seconds) == text
