"""Sweeps on this machine, done by a stand-in for the training."""

import os
import pathlib
import pickle
import signal
import subprocess
import sys

import pytest

from jaxil.files import locking
from jaxil.files.tables import read_csv
from jaxil.sweeps import clusters, display, state
from jaxil.sweeps.clusters import Cluster
from jaxil.sweeps.state import State
from tests import commands
from tests.commands import ROOT, SMALL, STATES, call
from tests.processes import wait_for
from tests.trainer import FRAMES, stand_in

_SECONDS = 100.0  # for what takes two on an idle machine


def test_cores_and_gpus_are_shared_out(monkeypatch):
    monkeypatch.setattr(clusters.os, "sched_getaffinity", lambda _: set(range(3, 11)))
    monkeypatch.setattr(clusters.devices, "uses_cpu", lambda: True)
    two = clusters.places(Cluster("local", num_workers=2), 10)
    assert [place.cores for place in two] == [(3, 4, 5, 6), (7, 8, 9, 10)]
    assert len(clusters.places(Cluster("local"), 100)) == 8
    assert len(clusters.places(Cluster("local"), 3)) == 3
    assert clusters.places(Cluster("local"), 0) == []
    monkeypatch.setattr(clusters.devices, "uses_cpu", lambda: False)
    monkeypatch.setattr(clusters.devices, "has_cuda_device", lambda: True)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")
    one_each = clusters.places(Cluster("local"), 10)
    assert [dict(place.environment) for place in one_each] == [
        {"CUDA_VISIBLE_DEVICES": "4"},
        {"CUDA_VISIBLE_DEVICES": "6"},
    ]
    assert len(one_each[0].cores) == 4
    shared = clusters.places(Cluster("local", num_workers=4), 10)
    assert dict(shared[3].environment) == {
        "CUDA_VISIBLE_DEVICES": "6",
        "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.45",
    }


def test_one_failure_stops_nothing_and_is_tried_again_by_the_next_sweep(
    tmp_path, capsys
):
    bad = stand_in(tmp_path, "bad", episodes=3, seconds=0.1, extra="--fail")
    runs = [bad, *(_quick(tmp_path, name) for name in ("one", "two", "three"))]
    assert _start(runs, tmp_path).wait(_SECONDS) == 0
    statuses = {run: state.status(run) for run in runs}
    assert display.counts(statuses.values()) == "1 failed, 3 finished"
    display.print_failures(statuses)
    shown = capsys.readouterr().out
    assert "bad/zero/seed0 failed (exit status 3)" in shown
    assert "the reason of the failure" in shown
    again = [bad._replace(command=_quick(tmp_path, "bad").command), *runs[1:]]
    clusters.start(Cluster("debug"), again, tmp_path, lambda: None)
    for run in again:
        _check_rows(run, processes=1)


def test_a_run_gets_the_cores_of_its_place(tmp_path):
    run = stand_in(tmp_path, "one", episodes=1, seconds=0.0, extra="--place")
    assert _start([run], tmp_path).wait(_SECONDS) == 0
    cores = sorted(os.sched_getaffinity(0))
    place = f"place {cores} {len(cores)}"
    assert place in (run.folder / "log.txt").read_text()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_an_interrupted_sweep_goes_on_and_repeats_nothing(tmp_path, number):
    runs = [
        stand_in(tmp_path, name, episodes=count, seconds=0.1)
        for name, count in (("one", 5), ("two", 100))
    ]
    process = _start(runs, tmp_path)
    wait_for(lambda: state.status(runs[1]).frame >= 7 * FRAMES)
    if number == signal.SIGINT:  # as a terminal does: to all of its processes
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    # The runs notice by themselves, save and end.
    wait_for(lambda: not any(state.is_in_use(run) for run in runs))
    process.wait()
    assert state.is_finished(runs[0])
    done = state.status(runs[1]).frame // FRAMES
    assert 7 <= done < 100
    assert state.status(runs[1]).state is State.PARTLY_DONE
    assert _start(runs, tmp_path).wait(_SECONDS) == 0
    assert f"from episode {done}\n" in (runs[1].folder / "log.txt").read_text()
    _check_rows(runs[0], processes=1)
    _check_rows(runs[1], processes=2)


def test_a_run_that_someone_else_does_is_waited_for(tmp_path):
    run = stand_in(tmp_path, "one", episodes=30, seconds=0.1)
    with subprocess.Popen(run.command, cwd=ROOT):
        wait_for(lambda: state.status(run).frame >= 3 * FRAMES)
        assert state.status(run).state is State.RUNNING
        assert _start([run], tmp_path).wait(_SECONDS) == 0
    _check_rows(run, processes=1)


def test_a_run_is_done_when_its_process_has_ended(tmp_path):
    """It writes a last checkpoint, then a video; until then it is no finished run."""
    run = _quick(tmp_path, "one")
    assert _start([run], tmp_path).wait(_SECONDS) == 0
    with locking.locked(run.folder / "lock"):
        sweep = _start([run], tmp_path)
        with pytest.raises(subprocess.TimeoutExpired):
            sweep.wait(5.0)
    assert sweep.wait(_SECONDS) == 0


def test_a_run_that_has_heard_a_signal_is_not_ended_by_its_worker(tmp_path):
    run = stand_in(tmp_path, "one", episodes=100, seconds=0.1, extra="--slow")
    process = _start([run], tmp_path)
    wait_for(lambda: state.status(run).frame >= 2 * FRAMES)
    trainer = int(read_csv(run.folder / "train.csv")["process"][-1])
    os.kill(trainer, signal.SIGTERM)  # it takes 5 s to save
    process.send_signal(signal.SIGTERM)
    process.wait(_SECONDS)
    assert "SIGHUP: request 2" in (run.folder / "log.txt").read_text()
    assert state.status(run).state is State.PARTLY_DONE
    done = state.status(run).frame
    assert (run.folder / "checkpoints" / f"frame_{done:012d}").exists()


def test_real_runs_from_the_plan_to_the_table(tmp_path):
    flags = [
        *("--methods=drqv2", "--preset=tiny", "--tasks=ball_in_cup_catch"),
        *("--seeds=1", "--workers=1", f"--workdir={tmp_path}", *SMALL),
        *(*STATES, "--config.total_frames=2000"),
    ]
    planned = call("sweep", *flags, "--dry_run")
    assert planned.returncode == 0, planned.stderr
    assert "1 missing" in planned.stdout
    assert "jaxil.launch --config=tiny:drqv2,ball_in" in planned.stdout
    assert not list(tmp_path.iterdir())
    done = commands.run("sweep", *flags)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "seed0: finished, return" in done.stdout
    home = tmp_path / "ball_in_cup_catch" / "drqv2" / "seed0"
    before = (home / "train.csv").stat().st_mtime_ns
    watched = call("sweep", *flags, "--watch")
    assert "2,000/2,000" in watched.stdout
    again = call("sweep", *flags)
    assert again.returncode == 0
    assert "1 finished" in again.stdout
    assert (home / "train.csv").stat().st_mtime_ns == before


def _quick(folder, name):
    return stand_in(folder, name, episodes=3, seconds=0.02)


_SWEEP = """
import pathlib, pickle, signal, sys
from jaxil.sweeps import clusters
def stop(number, frame):
    raise KeyboardInterrupt
signal.signal(signal.SIGTERM, stop)
folder = pathlib.Path(sys.argv[1])
runs = pickle.loads((folder / "runs").read_bytes())
clusters.start(clusters.Cluster("local", num_workers=1), runs, folder, lambda: None)
"""


def _start(runs, folder: pathlib.Path) -> subprocess.Popen:
    """Starts a local sweep as a process group of its own, which ignores SIGHUP."""
    (folder / "runs").write_bytes(pickle.dumps(runs))
    return subprocess.Popen(
        ["nohup", sys.executable, "-c", _SWEEP, str(folder)],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _check_rows(run, processes: int) -> None:
    """Checks that no episode is missing or was written twice."""
    assert state.is_finished(run)
    table = read_csv(run.folder / "train.csv")
    assert list(table["frame"]) == list(range(FRAMES, run.total_frames + 1, FRAMES))
    assert len(set(table["process"])) == processes
