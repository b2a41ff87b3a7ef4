"""Sweeps on a Slurm cluster: a real one, of this machine alone, made for the test."""

import contextlib
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import time

import numpy as np
import pytest

from jaxil.files.tables import read_csv
from jaxil.sweeps import clusters, state
from jaxil.sweeps.state import State
from tests.commands import ROOT, SMALL, STATES, call
from tests.trainer import FRAMES, stand_in

_DAEMONS = ("slurmctld", "slurmd")
# For what takes ten on an idle machine; Slurm may hold a requeued job for two minutes.
_SECONDS = 300.0
_CREDENTIAL_SECONDS = 2.0

_missing = [daemon for daemon in _DAEMONS if not shutil.which(daemon)]
if os.geteuid() != 0:
    _reason = "only root can start a cluster of its own"
else:
    _reason = f"{_missing[0]} is not installed (package slurm-wlm)" if _missing else ""
pytestmark = pytest.mark.skipif(bool(_reason), reason=f"no Slurm here: {_reason}")


@pytest.fixture(scope="module", autouse=True)
def cluster(tmp_path_factory):
    """Starts a controller and one node, on ports and in folders of their own."""
    home = tmp_path_factory.mktemp("slurm")
    for name in ("state", "spool"):
        (home / name).mkdir()
    host = socket.gethostname().split(".")[0]
    (home / "slurm.conf").write_text(_CONF.format(home=home, host=host, **_ports()))
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        patch.setenv("SLURM_CONF", str(home / "slurm.conf"))
        for name in _DAEMONS:
            log = stack.enter_context((home / f"{name}.out").open("w"))
            process = subprocess.Popen([name, "-D"], stdout=log, stderr=log)
            stack.callback(process.wait)
            stack.callback(process.terminate)
        _wait_for(lambda: "idle" in _output("sinfo", "--noheader", "--format=%T"))
        yield home
        _output("scancel", "--user=root")
        _wait_for(lambda: not _output("squeue", "--noheader"))


# Nobody else can reach it, so it knows no passwords.
_CONF = """
ClusterName=tests
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
AuthType=auth/none
CredType=cred/none
SlurmctldPort={control}
SlurmdPort={node}
SlurmctldPidFile={home}/slurmctld.pid
SlurmdPidFile={home}/slurmd.pid
StateSaveLocation={home}/state
SlurmdSpoolDir={home}/spool
SlurmctldLogFile={home}/slurmctld.log
SlurmdLogFile={home}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
KillWait=5
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SchedulerParameters=sched_interval=2
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=debug Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture(autouse=True)
def streams(monkeypatch):
    # submitit would close the streams that pytest captures.
    monkeypatch.setenv("SUBMITIT_LOG_LEVEL", "NOCONFIG")
    monkeypatch.chdir(ROOT)


def _submit(runs, folder):
    cluster = clusters.Cluster("slurm", hours=1.0, num_gpus=0, num_cpus=1)
    clusters.submit(cluster, runs, folder / ".sweep")


@pytest.mark.parametrize(
    "signals", [["USR2"], ["TERM", "USR2"]], ids=["timeout", "preemption"]
)
def test_a_warned_job_saves_is_queued_again_and_goes_on(tmp_path, signals):
    run = stand_in(tmp_path, "warned", episodes=42, seconds=0.2, extra="--slow")
    _submit([run], tmp_path)
    job = state.slurm_job(run)
    assert job is not None
    _wait_for(lambda: _rows(run) >= 7)
    assert state.status(run).state is State.RUNNING
    for name in signals:
        _output("scancel", f"--signal={name}", job)
    _wait_for(lambda: state.status(run).state is not State.RUNNING)
    done = _rows(run)
    assert done < 42
    # It saved when it was asked to, not only every five episodes.
    assert (run.folder / "checkpoints" / f"frame_{done * FRAMES:012d}").exists()
    assert job in clusters.queued_jobs([run])
    _wait_for_requeued(job, lambda: state.is_finished(run))
    assert f"from episode {done}\n" in (run.folder / "log.txt").read_text()
    _check_rows(run, processes=2)


def test_a_job_that_was_killed_goes_on_from_its_last_checkpoint(tmp_path):
    killed, other = (
        stand_in(tmp_path, name, episodes=30, seconds=0.2) for name in ("one", "two")
    )
    _submit([killed, other], tmp_path)
    job = state.slurm_job(killed)
    assert job is not None
    assert "_" in job  # of an array
    _wait_for(lambda: _rows(killed) >= 7)
    # As when a node breaks down: nobody is warned.
    trainer = int(read_csv(killed.folder / "train.csv")["process"][-1])
    worker = int(pathlib.Path(f"/proc/{trainer}/stat").read_text().split()[3])
    for process in (worker, trainer):
        os.kill(process, signal.SIGKILL)
    _wait_for(lambda: job not in clusters.queued_jobs([killed]))
    _output("scontrol", "requeue", job)
    _wait_for_requeued(job, lambda: state.is_finished(killed))
    _wait_for(lambda: state.is_finished(other))
    assert "from episode 5\n" in (killed.folder / "log.txt").read_text()
    _check_rows(killed, processes=2)
    _check_rows(other, processes=1)
    assert state.failure(killed) is None


def test_a_cancelled_job_saves_and_stays_away(tmp_path):
    run = stand_in(tmp_path, "cancelled", episodes=1000, seconds=0.2)
    _submit([run], tmp_path)
    _wait_for(lambda: _rows(run) >= 2)
    _output("scancel", state.slurm_job(run) or "")
    _wait_for(lambda: not clusters.queued_jobs([run]))
    _wait_for(lambda: state.status(run).state is State.PARTLY_DONE)
    done = _rows(run)
    assert (run.folder / "checkpoints" / f"frame_{done * FRAMES:012d}").exists()


def test_a_sweep_of_real_runs_survives_a_requeue(tmp_path):
    arguments = [
        *("--cluster=slurm", "--gpus=0", "--cpus=1", "--methods=drqv2"),
        *("--preset=tiny", "--tasks=ball_in_cup_catch", "--seeds=1"),
        *(f"--workdir={tmp_path}", *SMALL, *STATES, "--config.total_frames=8000"),
    ]
    assert "1 submitted" in _sweep(*arguments)
    home = tmp_path / "ball_in_cup_catch" / "drqv2" / "seed0"
    # The same command again finds it queued, or running.
    assert "0 submitted" in _sweep(*arguments)
    _wait_for(lambda: list(home.glob("checkpoints/frame_*")), seconds=400)
    job = (home / "slurm_job").read_text()
    _output("scontrol", "requeue", job)
    watch = (*arguments, "--watch")
    _wait_for_requeued(job, lambda: "1 finished" in _sweep(*watch), seconds=400)
    assert "resuming from the checkpoint" in (home / "log.txt").read_text()
    table = read_csv(home / "train.csv")
    assert list(table["episode"]) == list(range(8))
    np.testing.assert_array_equal(table["frame"], 1000 * np.arange(1, 9))


def _sweep(*arguments) -> str:
    done = call("sweep", *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _wait_for_requeued(job: str, condition, seconds: float = _SECONDS) -> None:
    """Waits without the two minutes for which Slurm holds a requeued job back."""
    _wait_for(lambda: _state_of(job) == "PENDING")
    # Slurm holds it back because a node refuses a job that starts again within the
    # second in which it was ended ("Job credential revoked"), and then it has failed.
    time.sleep(_CREDENTIAL_SECONDS)

    def holds() -> bool:
        if _state_of(job) == "PENDING":
            _output("scontrol", "update", f"JobId={job}", "StartTime=now")
        return condition()

    _wait_for(holds, seconds)


def _state_of(job: str) -> str:
    return _output("squeue", "--noheader", f"--jobs={job}", "--format=%T").strip()


def _ports() -> dict[str, int]:
    with socket.socket() as first, socket.socket() as second:
        for one in (first, second):
            one.bind(("127.0.0.1", 0))
        return {"control": first.getsockname()[1], "node": second.getsockname()[1]}


def _rows(run) -> int:
    return state.status(run).frame // FRAMES


def _check_rows(run, processes: int) -> None:
    """Checks that no episode is missing or was written twice."""
    table = read_csv(run.folder / "train.csv")
    assert list(table["frame"]) == list(range(FRAMES, run.total_frames + 1, FRAMES))
    assert len(set(table["process"])) == processes


def _output(*arguments: str) -> str:
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
    return done.stdout


def _wait_for(condition, seconds: float = _SECONDS) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"too slow\n{_what_slurm_says()}"
        time.sleep(0.2)


def _what_slurm_says() -> str:
    home = pathlib.Path(os.environ["SLURM_CONF"]).parent
    logs = [home / f"{name}.log" for name in _DAEMONS]
    tails = (path.read_text()[-3000:] for path in logs if path.exists())
    return "\n".join([_output("scontrol", "show", "jobs"), *tails])
