"""What the folders of a sweep's runs tell, also damaged ones."""

import pytest

from jaxil.files import locking
from jaxil.sweeps import clusters, display, plan, state
from jaxil.sweeps.clusters import Cluster
from jaxil.sweeps.state import State, Status
from jaxil.training import workdir
from tests.sweep_plans import config_of, make_runs
from tests.trainer import stand_in


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
    *(b"frame,seconds\n1000\n", b"frame\n1e999\n", b'frame\n"\n'),
    b"x" * 200_000 + b"\n1\n",
)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(("config.json", content) for content in _BAD_CONFIGS),
        *(("train.csv", content) for content in _BAD_TABLES),
    ],
)
def test_a_damaged_run_is_shown_and_the_others_go_on(tmp_path, name, content, capsys):
    bad, good = make_runs(tmp_path, methods=["pdac"], tasks=["walker_run"])
    bad.folder.mkdir(parents=True)
    workdir.write_config(bad.folder, config_of(bad), {})
    for file in ("failed.json", "slurm_job"):
        (bad.folder / file).write_bytes(content)
    (bad.folder / name).write_bytes(content)
    assert make_runs(tmp_path, methods=["pdac"], tasks=["walker_run"]) == [bad, good]
    statuses = {run: state.status(run) for run in (bad, good)}
    assert display.counts(statuses.values()) == "1 damaged, 1 missing"
    display.print_plan(statuses)
    display.watch(lambda: statuses)
    assert "seed0 is damaged: " in capsys.readouterr().out
    # A table is set aside by the run itself; without settings there is no run.
    assert bool(state.damage(bad)) == (name == "config.json")


def test_a_file_in_place_of_a_runs_folder_is_damage(tmp_path):
    (run,) = make_runs(tmp_path, methods=["pdac"], tasks=["walker_run"], num_seeds=1)
    run.folder.parent.mkdir(parents=True)
    run.folder.touch()
    assert make_runs(tmp_path, methods=["pdac"], tasks=["walker_run"], num_seeds=1) == [
        run
    ]
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
    todo, guess = (two, three, other), display.GUESSES["tiny", "CPU"]
    # two and three go on at the median 75 frames/s, other at the guess of 40: 80 s,
    # 133 s and 250 s.
    told = display.estimate(todo, statuses, num_at_once=9, guess=guess)
    assert told.startswith("Left to do: 26,000 frames, 0.1 hours of runs; about 4 min")
    assert "with 9 at a time (a guess: 40 frames/s for drqv2" in told
    told = display.estimate(todo, statuses, num_at_once=1, guess=guess)
    assert "about 8 min with 1" in told
