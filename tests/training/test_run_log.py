"""What a run writes beside its checkpoints, and what it says when it cannot."""

import ast
import contextlib
import errno
import importlib.metadata
import os
import pathlib
import shutil
import time

import matplotlib.image
import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil.environments.evaluation import Evaluation
from jaxil.errors import MethodError, UsageError
from jaxil.files.tables import CsvLog, read_csv
from jaxil.training import film, learning_curve, loggers, run_log
from jaxil.training.evaluator import Result
from jaxil.training.workdir import RunFolderError
from tests.commands import call
from tests.processes import wait_for


@pytest.fixture
def make_outputs():
    made = []

    def make(folder, resume_frame=None, logger=""):
        config = jaxil_config.default_config("drqv2", "cartpole_swingup")
        config.logger = logger
        made.append(run_log.RunLog(folder, config, None, resume_frame))
        return made[-1]

    yield make
    for outputs in made:
        with contextlib.suppress(RunFolderError, ValueError):  # closed already
            outputs.close()


def write_episode(outputs, frame=1000, metrics=None):
    row = {
        "task_return": 12.5,
        "imitation_return": 1.0,
        "length": 500,
        "reward_seconds": 0.0,
        **(metrics or {"critic/loss": 0.25, "actor/pre_tanh": 4.0}),
    }
    outputs.episode(run_log.When(frame, frame / 100, 0), row)


def test_a_metric_that_the_method_does_not_declare_is_named(make_outputs, tmp_path):
    outputs = make_outputs(tmp_path)
    write_episode(outputs)
    with pytest.raises(MethodError, match=r"drqv2 .*: mine/loss; .*METHOD"):
        write_episode(outputs, metrics={"critic/loss": 0.25, "mine/loss": 1.0})


_SIDE = film.Side(np.zeros((2, 24, 24, 3), np.uint8), ["", ""])


def write_evaluation(outputs, frame=1000, sides=()):
    evaluation = Evaluation([], np.array([10.0, 30.0]), [])
    result = Result(evaluation, distance=0.5, sides=list(sides), filmed={})
    return outputs.evaluation(run_log.When(frame, 20.0, 1), result, pre_tanh=4.0)


def test_tables_events_and_curve(make_outputs, tmp_path):
    outputs = make_outputs(tmp_path)
    write_episode(outputs)
    when = run_log.When(frame=1000, seconds=11.0, episode=0)
    outputs.updates(when, {"actor/loss": float("nan")})
    line = write_evaluation(outputs)

    assert line.startswith("frame 1000: task return 20.0 ± 10.0; the actor saturates")
    train = read_csv(tmp_path / "train.csv")
    assert list(train) == list(run_log.TRAIN_COLUMNS)
    assert train["task_return"][0] == 12.5
    assert train["frames_per_second"][0] == 100.0
    evaluations = read_csv(tmp_path / "eval.csv")
    assert list(evaluations) == list(run_log.EVAL_COLUMNS)
    assert evaluations["wasserstein_to_expert"] == [0.5]
    assert (tmp_path / "learning_curve.png").exists()
    (events,) = (tmp_path / "tensorboard").iterdir()
    content = events.read_bytes()
    for tag in (b"train/task_return", b"eval/task_return_mean", b"train/critic/loss"):
        assert tag in content
    assert b"actor/loss" not in content  # of no update yet: it has no number


_OWN = """
import pathlib


class Notes:
    def __init__(self, workdir, config, resume_frame):
        self.notes = [(config["method"], resume_frame)]

    def write_scalars(self, group, frame, values):
        self.notes.append((group, frame, values["seconds"]))

    def write_video(self, frame, path):
        self.notes.append((frame, path.name, path.is_file()))

    def close(self):
        pathlib.Path(__file__).with_name("notes").write_text(repr(self.notes))
"""


def test_a_logger_of_ones_own_gets_every_row_and_video(
    make_outputs, tmp_path, monkeypatch
):
    (tmp_path / "own_logger.py").write_text(_OWN)
    monkeypatch.syspath_prepend(tmp_path)
    assert loggers.problems("own_logger:Notes") == []
    assert "no attribute 'Note'" in str(loggers.problems("own_logger:Note"))
    assert "must be wandb or" in str(loggers.problems("wanbd"))
    outputs = make_outputs(tmp_path, 500, "own_logger:Notes")
    write_episode(outputs)
    write_evaluation(outputs, sides=[_SIDE])
    outputs.close()
    assert ast.literal_eval((tmp_path / "notes").read_text()) == [
        ("drqv2", 500),
        ("train", 1000, 10.0),
        ("eval", 1000, 20.0),
        (1000, "frame_000001000.mp4", True),
    ]


def test_weights_and_biases_logs_offline_and_goes_on_in_the_same_run(
    make_outputs, tmp_path, monkeypatch
):
    for name in [name for name in os.environ if name.startswith("WANDB_")]:
        monkeypatch.delenv(name)
    outputs = make_outputs(tmp_path, logger="wandb")
    write_episode(outputs)
    write_evaluation(outputs, sides=[_SIDE])
    outputs.close()
    (first,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    # W&B's own process closes the file, a moment later.
    for word in (b"train/task_return", b"eval/task_return_mean", b"drqv2 on cartpole"):
        wait_for(lambda word=word: word in first.read_bytes())
    assert list(first.parent.glob("files/media/videos/*.mp4"))
    time.sleep(1.0)  # names of W&B's folders hold whole seconds
    make_outputs(tmp_path, 1000, "wandb").close()
    assert len(list(tmp_path.glob(f"wandb/offline-run-*/{first.name}"))) == 2

    monkeypatch.setenv("WANDB_MODE", "online")
    monkeypatch.setenv("HOME", str(tmp_path))  # where nobody is logged in
    config = jaxil_config.default_config("drqv2", "cartpole_swingup").to_dict()
    with pytest.raises(UsageError, match="wandb login"):
        loggers.WeightsAndBiases(tmp_path, config, None)


def test_a_missing_weights_and_biases_is_one_message(tmp_path, monkeypatch):
    def version(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(loggers.importlib.metadata, "version", version)
    flags = ("--config=zero:cartpole_swingup", "--config.logger=wandb")
    refused = call("launch", *flags, f"--workdir={tmp_path / 'run'}")
    assert refused.returncode == 2
    assert "pip install '.[wandb]'" in refused.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_damaged_tables_do_not_stop_a_resumed_run(make_outputs, tmp_path, capsys):
    (tmp_path / "train.csv").write_bytes(b"")
    (tmp_path / "eval.csv").write_bytes(b"\xff\n")
    outputs = make_outputs(tmp_path, resume_frame=1000)
    write_episode(outputs, frame=2000)
    outputs.close()
    assert read_csv(tmp_path / "train.csv")["frame"] == [2000]
    said = capsys.readouterr().err
    assert "kept as train.csv.damaged" in said
    assert "kept as eval.csv.damaged" in said


@pytest.mark.parametrize("fault", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_full_disk_is_one_sentence_with_the_newest_checkpoint(
    make_outputs, tmp_path, monkeypatch, fault
):
    (tmp_path / "checkpoints" / "frame_000000004000").mkdir(parents=True)
    (tmp_path / "checkpoints" / ".tmp-1-frame_000000005000").mkdir()
    outputs = make_outputs(tmp_path)

    def fail(*_):
        raise OSError(fault, "the reason", str(tmp_path / "train.csv"))

    monkeypatch.setattr(CsvLog, "append", fail)
    for write in (write_episode, write_evaluation):
        with pytest.raises(RunFolderError) as caught:
            write(outputs)
        assert str(caught.value) == (
            f"workdir={str(tmp_path)!r} cannot be written: the reason (train.csv); "
            "newest checkpoint: of frame 4000. Make room or make it writable, then "
            "rerun the same command to resume"
        )


def test_a_full_disk_under_the_events_is_the_same(make_outputs, tmp_path, monkeypatch):
    # Not a hang, which it was with tensorboardX's own thread.
    with contextlib.suppress(OSError), pathlib.Path("/dev/full").open("wb") as full:
        monkeypatch.setattr("tensorboardX.record_writer.open_file", lambda _: full)
        outputs = make_outputs(tmp_path)
        with pytest.raises(RunFolderError, match="No space left"):
            write_episode(outputs)


@pytest.mark.parametrize(
    "remove", [shutil.rmtree, lambda path: path.rename(path.with_name("moved"))]
)
def test_a_folder_that_is_gone_is_one_sentence(make_outputs, tmp_path, remove):
    folder = tmp_path / "run"
    folder.mkdir()
    outputs = make_outputs(folder)
    remove(folder)
    with pytest.raises(RunFolderError, match="has been deleted or moved"):
        write_episode(outputs)
    assert not folder.exists()


@pytest.mark.parametrize("num_rows", [0, 1, 30])
def test_the_learning_curve_is_a_picture(tmp_path, num_rows):
    log = CsvLog(tmp_path / "eval.csv", run_log.EVAL_COLUMNS)
    for row in range(1, num_rows + 1):
        mean = 700 * (1 - np.exp(-row / 8))
        log.append(
            {
                "frame": 10_000 * row,
                "task_return_mean": mean,
                "task_return_std": mean / 9,
            }
        )

    learning_curve.plot(
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
