"""Sweeps: what is planned, what is done, what is done again, and what is refused."""

import os
import pathlib
import pickle
import signal
import subprocess
import sys

import pytest

from jaxil.errors import Fault, UsageError
from jaxil.files import locking
from jaxil.files.tables import read_csv
from jaxil.sweeps import clusters, plan, state, tables
from jaxil.sweeps.clusters import Cluster
from jaxil.sweeps.state import State, Status
from jaxil.training import workdir
from tests import commands
from tests.commands import ROOT, SMALL, STATES, call
from tests.processes import wait_for
from tests.trainer import FRAMES, stand_in

_SECONDS = 100.0  # for what takes two on an idle machine


def _runs(folder, config_problems=lambda config: [], **changes):
    settings = {
        "methods": ["pdac", "psil"],
        "ablations": [],
        "tasks": ["cartpole_swingup", "walker_run"],
        "num_seeds": 2,
        "preset": "paper",
        "folder": folder,
        "overrides": {},
        **changes,
    }
    return plan.make_runs(plan.Request(**settings), config_problems)


def _config(run):
    return plan.command.read_config(
        word for word in run.command if word.startswith("--config")
    )


def _faults(folder, *arguments, **changes):
    with pytest.raises(UsageError) as raised:
        _runs(folder, *arguments, **changes)
    return [str(fault) for fault in raised.value.faults]


# The plan.


def test_all_tasks_variants_and_seeds_are_planned_seed_by_seed(tmp_path):
    runs = _runs(tmp_path)
    assert [run.name for run in runs] == [
        "cartpole_swingup/pdac/seed0",
        "cartpole_swingup/psil/seed0",
        "walker_run/pdac/seed0",
        "walker_run/psil/seed0",
        "cartpole_swingup/pdac/seed1",
        "cartpole_swingup/psil/seed1",
        "walker_run/pdac/seed1",
        "walker_run/psil/seed1",
    ]
    last = runs[-1]
    assert last.folder == tmp_path / "walker_run" / "psil" / "seed1"
    assert last.total_frames == 5_000_000
    config = _config(last)
    assert (config.method, config.task, config.seed) == ("psil", "walker_run", 1)
    assert f"--workdir={last.folder}" in last.command


def test_an_ablation_has_its_variants_and_its_shorter_budget(tmp_path):
    runs = _runs(tmp_path, methods=[], ablations=["figure8"], num_seeds=1)
    budgets = {f"{run.task}/{run.slug}": run.total_frames for run in runs}
    assert budgets == {
        "cartpole_swingup/pdac": 1_500_000,
        "cartpole_swingup/pdac_actions": 1_500_000,
        "walker_run/pdac": 3_000_000,
        "walker_run/pdac_actions": 3_000_000,
    }
    actions = _config(runs[-1])
    assert actions.discriminator.sees_actions
    assert actions.total_frames == 3_000_000


def test_methods_and_ablations_make_a_union_with_the_longer_budget(tmp_path):
    runs = _runs(tmp_path, ablations=["figure8", "figure12"], num_seeds=1)
    budgets = {r.slug: r.total_frames for r in runs if r.task == "walker_run"}
    assert budgets == {
        "pdac": 5_000_000,
        "psil": 5_000_000,
        "pdac_actions": 3_000_000,
    }
    assert len(runs) == 2 * len(budgets)
    chosen = _runs(
        tmp_path,
        methods=[],
        ablations=["figure8"],
        overrides={"total_frames": "4000"},
    )
    assert {run.total_frames for run in chosen} == {4000}


def test_a_changed_field_names_the_variant_that_it_makes(tmp_path):
    overrides = {"shift_padding": "0"}
    runs = _runs(tmp_path, methods=["pdac"], preset="tiny", overrides=overrides)
    assert {run.slug for run in runs} == {"pdac_no_augmentation"}
    overrides = {"discriminator.sees_actions": "True"}
    (fault,) = _faults(tmp_path, methods=[], ablations=["figure8"], overrides=overrides)
    assert "is what a figure varies; leave it out" in fault


def test_a_field_changes_the_methods_that_have_it(tmp_path):
    overrides = {"discriminator.batch_size": "8", "batch_size": "32"}
    pdac, psil = _runs(tmp_path, tasks=["walker_run"], num_seeds=1, overrides=overrides)
    assert _config(pdac).discriminator.batch_size == 8
    assert _config(psil).batch_size == 32
    assert "discriminator" not in _config(psil)
    (fault,) = _faults(tmp_path, methods=["psil", "bc"], overrides=overrides)
    assert "field='discriminator.batch_size' is unknown" in fault


@pytest.mark.parametrize("preset", plan.PRESETS)
def test_a_method_from_outside_is_planned(tmp_path, monkeypatch, preset):
    (tmp_path / "outsider.py").write_text(_OUTSIDER)
    monkeypatch.syspath_prepend(tmp_path)
    overrides = {"own.strength": "2.5"}
    runs = _runs(
        tmp_path, methods=["outsider:METHOD"], preset=preset, overrides=overrides
    )
    assert runs[0].name == "cartpole_swingup/outsider_METHOD/seed0"
    config = _config(runs[-1])
    assert (config.method, config.task) == ("outsider:METHOD", "walker_run")
    assert config.own.strength == 2.5
    assert (config.image_size == 84) == (preset == "paper")
    (fault,) = _faults(tmp_path, methods=["nowhere:METHOD"])
    assert "--methods='nowhere:METHOD' names no module" in fault


_OUTSIDER = """
from jaxil import methods

METHOD = methods.Method(
    name="outsider",
    label="Outsider",
    about="nothing",
    sections={"own": {"strength": methods.Field(1.0, "of it", 0.0, 9.0)}},
    uses_demonstrations=False,
)
"""


# What is refused, all of it together.


def test_every_fault_of_every_run_is_told_once(tmp_path):
    (tmp_path / "file").touch()
    told = _faults(
        tmp_path / "file" / "x",
        lambda config: [Fault("x", "is bad")] if config.method == "pdac" else [],
        methods=["gail", "pdac", "psil"],
        ablations=["figure1"],
        num_seeds=0,
        overrides={"seed": "3", "batchsize": "7", "image_size": "big"},
    )
    expected = (
        "--methods='gail' is unknown; choose one of: pdac, psil",
        "--ablation='figure1' is unknown",
        "--seeds=0 must be at least 1",
        "not writable",
        "--config.seed='3' is what the sweep itself sets; use --seeds",
        "field='batchsize' is unknown; did you mean: batch_size",
        "image_size='big' has the wrong type: expected a whole number",
    )
    for fault, words in zip(told, expected, strict=True):
        assert words in fault
    assert "[" not in told[-1]  # all runs have it


def test_a_fault_of_some_runs_says_which(tmp_path):
    faults = [Fault("demonstrations", "are missing")]
    (fault,) = _faults(tmp_path, lambda config: faults * (config.task == "walker_run"))
    assert fault == "demonstrations are missing [walker_run/pdac, walker_run/psil]"


def test_a_folder_with_another_run_is_refused(tmp_path):
    (run, *_) = _runs(tmp_path, methods=["pdac"], tasks=["walker_run"])
    config = _config(run)
    config.batch_size = 17
    run.folder.mkdir(parents=True)
    workdir.write_config(run.folder, config, {})
    (fault,) = _faults(tmp_path, methods=["pdac"], tasks=["walker_run"])
    assert "batch_size: 17 there, 256 here" in fault
    assert fault.endswith("[walker_run/pdac/seed0]")


def test_clusters_that_are_not_there(monkeypatch):
    monkeypatch.setattr(clusters.shutil, "which", lambda name: None)
    monkeypatch.setattr(clusters.importlib.util, "find_spec", lambda name: None)
    many = Cluster("slurm", num_workers=10**6, hours=0.0, num_gpus=2, num_cpus=0)
    told = "\n".join(map(str, clusters.problems(many, starts=True)))
    for words in ("no Slurm here", "pip install submitit", "--workers=", "--hours=0.0",
                  "--gpus=2", "--cpus=0"):  # fmt: skip
        assert words in told
    assert not list(clusters.problems(Cluster("slurm"), starts=False))
    (fault,) = clusters.problems(Cluster("pbs"), starts=True)
    assert "local, slurm, debug" in str(fault)


def test_slurm_commands_without_a_cluster_are_no_slurm(tmp_path, monkeypatch):
    for name, text in (("sbatch", ""), ("sinfo", "echo 'no controller' >&2; exit 1")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    (fault,) = clusters.problems(Cluster("slurm"), starts=True)
    assert "no Slurm here: sinfo fails (no controller)" in str(fault)


def test_wrong_use_of_the_command_ends_with_status_2(tmp_path):
    done = call(
        "sweep",
        *("--methods=gail", "--seeds=0", "--cluster=pbs", "--tasks=walker_wlak"),
        *("--config.bath_size", "8"),
    )
    assert done.returncode == 2
    for words in (
        "gail",
        "--seeds=0",
        "'pbs'",
        "--workdir is missing or empty",
        "walker_walk",
        "'bath_size'",
    ):
        assert words in done.stderr
    assert "Traceback" not in done.stderr


# Shares of a machine.


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


# What a run's folder tells.


def test_states_of_a_run(tmp_path):
    run = stand_in(tmp_path, "one", episodes=10, seconds=0.0)
    assert state.status(run) == Status(State.MISSING, 0, 0.0, None)
    state.note_slurm_job(run, "7_0")
    assert state.status(run, frozenset({"7_0"})).state is State.QUEUED
    assert state.status(run, frozenset({"7_1"})).state is State.MISSING
    config = plan.jaxil_config.default_config("zero", "walker_walk")
    workdir.write_config(run.folder, config, {})
    header = "frame,seconds\n"
    (run.folder / "train.csv").write_text(header)
    assert state.status(run).frame == 0
    (run.folder / "train.csv").write_text(header + "8000,40.0\n9000,45.0\n10000,5")
    status = state.status(run)  # the last line was cut off
    assert (status.state, status.frame) == (State.PARTLY_DONE, 9000)
    assert status.frames_per_second == 200.0
    state.note_failure(run, 3)
    assert (state.status(run).state, state.failure(run)) == (State.FAILED, 3)
    with locking.locked(run.folder / "claim"):
        assert state.status(run).state is State.RUNNING
    (run.folder / "checkpoints" / "frame_000000010000").mkdir(parents=True)
    assert state.status(run).state is State.FINISHED
    # Prolonged, it is no longer finished.
    assert not state.is_finished(run._replace(total_frames=11_000))


def test_tables_decide_where_checkpoints_were_cleared_away(tmp_path):
    run = stand_in(tmp_path, "one", episodes=1, seconds=0.0)
    run.folder.mkdir(parents=True)
    for name, frame in (("train.csv", 1000), ("eval.csv", 900)):
        (run.folder / name).write_text(f"frame,seconds\n{frame},1\n")
    assert not state.is_finished(run)
    (run.folder / "eval.csv").write_text("frame,seconds\n1000,1\n")
    assert state.is_finished(run)


_BAD_CONFIGS = (b"", b"[" * 200_000, b"\xff", b'{"config": {"method": 1}}', b"5")
_BAD_TABLES = (
    *(b"\0" * 100 + b"\n", b"frame\n\xff\xfe\n", b"frame,seconds\n1000,nan\n"),
    *(
        b"frame,seconds\n1000\n",
        b"frame\n1e999\n",
        b'frame\n"\n',
        b"x" * 200_000 + b"\n1\n",
    ),
)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(("config.json", content) for content in _BAD_CONFIGS),
        *(("train.csv", content) for content in _BAD_TABLES),
    ],
)
def test_a_damaged_run_is_shown_and_the_others_go_on(tmp_path, name, content, capsys):
    bad, good = _runs(tmp_path, methods=["pdac"], tasks=["walker_run"])
    bad.folder.mkdir(parents=True)
    workdir.write_config(bad.folder, _config(bad), {})
    for file in ("failed.json", "slurm_job"):
        (bad.folder / file).write_bytes(content)
    (bad.folder / name).write_bytes(content)
    assert _runs(tmp_path, methods=["pdac"], tasks=["walker_run"]) == [bad, good]
    statuses = {run: state.status(run) for run in (bad, good)}
    assert tables.summary(statuses) == "1 damaged, 1 missing"
    tables.print_plan(statuses)
    tables.watch(lambda: statuses)
    assert "seed0 is damaged: " in capsys.readouterr().out
    # A table is set aside by the run itself; without settings there is no run.
    assert bool(state.damage(bad)) == (name == "config.json")


def test_a_file_in_place_of_a_runs_folder_is_damage(tmp_path):
    (run,) = _runs(tmp_path, methods=["pdac"], tasks=["walker_run"], num_seeds=1)
    run.folder.parent.mkdir(parents=True)
    run.folder.touch()
    assert _runs(tmp_path, methods=["pdac"], tasks=["walker_run"], num_seeds=1) == [run]
    assert state.status(run).state is State.DAMAGED
    clusters.start(Cluster("debug"), [run], tmp_path, lambda: None)
    assert run.folder.read_bytes() == b""


def test_no_run_seems_to_go_on_where_there_are_no_locks(tmp_path, monkeypatch):
    run = stand_in(tmp_path, "one", episodes=3, seconds=0.0)
    run.folder.mkdir(parents=True)
    (run.folder / "lock").touch()

    def refuse(*_):
        raise OSError(locking.errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locking.fcntl, "flock", refuse)
    assert state.status(run).state is State.MISSING
    clusters.start(Cluster("debug"), [run], tmp_path, lambda: None)
    assert state.status(run).state is State.FINISHED
    with locking.locked(run.folder / "claim"):
        assert state.is_in_use(run)


def test_cost_by_hand(tmp_path):
    one, two, three = (
        stand_in(tmp_path, name, episodes=10, seconds=0.0) for name in "abc"
    )
    other = three._replace(method="drqv2")
    statuses = {
        one: Status(State.FINISHED, 10_000, 100.0, 5.0),
        two: Status(State.PARTLY_DONE, 4_000, 80.0, None),
        three: Status(State.MISSING),
        other: Status(State.MISSING),
    }
    todo = {run: statuses[run] for run in (two, three, other)}
    # two and three go on at the median 75 frames/s, other at the guess of 40: 80 s,
    # 133 s and 250 s.
    told = tables.estimate(todo, statuses, num_at_once=9, preset="tiny", on_gpu=False)
    assert told.startswith("Left to do: 26,000 frames, 0.1 hours of runs; about 4 min")
    assert "with 9 at a time (a guess: 40 frames/s for drqv2" in told
    told = tables.estimate(todo, statuses, num_at_once=1, preset="tiny", on_gpu=False)
    assert "about 8 min with 1" in told


# Runs on this machine, done by a stand-in for the training.


def test_one_failure_stops_nothing_and_is_tried_again_by_the_next_sweep(
    tmp_path, capsys
):
    bad = stand_in(tmp_path, "bad", episodes=3, seconds=0.1, extra="--fail")
    runs = [bad, *(_quick(tmp_path, name) for name in ("one", "two", "three"))]
    assert _start(runs, tmp_path).wait(_SECONDS) == 0
    statuses = {run: state.status(run) for run in runs}
    assert tables.summary(statuses) == "1 failed, 3 finished"
    tables.print_failures(statuses)
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
