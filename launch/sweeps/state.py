"""How far a run has come, told from its folder alone.

Nothing else remembers a sweep, so that it can be killed anywhere, watched from
elsewhere and begun again. Beside what `jaxil.launch` writes, a run's folder holds

    log.txt      what its processes have printed
    claim        locked while a worker, or a process that it started, has the run
    failed.json  exit status of a process that ended by its own fault
    slurm_job    number of the Slurm job that waits for it or runs it
"""

import contextlib
import csv
import enum
import fcntl
import json
import os
import pathlib
import re
import time
from collections.abc import Iterator
from typing import IO, NamedTuple

from jaxil.files.writing import write_atomically
from launch.sweeps.plan import Run

_CHECKPOINT = re.compile(r"frame_(\d+)(?:_\d+)?")
_TAIL_BYTES = 16_384  # holds many rows of a table, and the last lines of a log
# Who looks whether a claim is free holds it for a moment; that is not a claim.
_CLAIM_TRIES, _CLAIM_SECONDS = 5, 0.05


class State(enum.StrEnum):
    """What has to be done about a run."""

    RUNNING = "running"
    FAILED = "failed"
    QUEUED = "queued"
    PARTLY_DONE = "partly done"
    MISSING = "missing"
    FINISHED = "finished"


class Status(NamedTuple):
    """A run, looked at.

    Attributes:
      state: see `State`.
      frame: environment frames in its tables.
      seconds: that these took, evaluations included.
      last_return: task return of the newest evaluation; None before the first.
    """

    state: State
    frame: int
    seconds: float
    last_return: float | None

    @property
    def frames_per_second(self) -> float | None:
        """Mean speed of the whole run; None before its first episode."""
        return self.frame / self.seconds if self.frame and self.seconds else None


def status(run: Run, queued: frozenset[str] = frozenset()) -> Status:
    """Looks at a run; cheap, however long its tables are.

    Args:
      run: need not have begun.
      queued: the Slurm jobs that wait or run.
    """
    row = _last_row(run.folder / "train.csv")
    evaluation = _last_row(run.folder / "eval.csv")
    last_return = evaluation.get("task_return_mean")
    return Status(
        state=_state(run, queued),
        frame=int(row.get("frame", 0)),
        seconds=float(row.get("seconds", 0.0)),
        last_return=None if last_return is None else float(last_return),
    )


def is_finished(run: Run) -> bool:
    """Returns whether the budget is used up.

    The newest checkpoint decides, as it does for `jaxil.launch`: it is written after
    the last rows. Where someone has cleared the checkpoints away, the tables do.
    """
    checkpoints = run.folder / "checkpoints"
    names = [path.name for path in checkpoints.glob("frame_*")]
    frames = [int(m[1]) for name in names if (m := _CHECKPOINT.fullmatch(name))]
    if not frames:
        tables = (run.folder / name for name in ("train.csv", "eval.csv"))
        frames = [min(int(_last_row(table).get("frame", 0)) for table in tables)]
    return max(frames) >= run.total_frames


def is_in_use(run: Run) -> bool:
    """Returns whether a worker has the run, or someone who started it by hand."""
    return _is_locked(run.folder / "claim") or _is_locked(run.folder / "lock")


@contextlib.contextmanager
def claimed(run: Run) -> Iterator[IO[str] | None]:
    """Gives a run to one worker at a time, on all machines that share the folder.

    Yields:
      The locked file, for the processes that the worker starts to inherit: the run
      stays claimed until the last of them has ended. None where another has the run.
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / "claim").open("a") as file:
        for _ in range(_CLAIM_TRIES):
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                yield file
                return
            time.sleep(_CLAIM_SECONDS)
        yield None


def note_failure(run: Run, exit_status: int) -> None:
    """Notes that the run's process has ended by its own fault."""
    content = {"exit_status": exit_status, "command": list(run.command)}
    write_atomically(run.folder / "failed.json", json.dumps(content).encode())


def failure(run: Run) -> int | None:
    """Returns the exit status that `note_failure` noted; None without."""
    try:
        return int(json.loads((run.folder / "failed.json").read_text())["exit_status"])
    except (OSError, ValueError, KeyError):
        return None


def forget_failure(run: Run) -> None:
    """Lets workers try the run again."""
    (run.folder / "failed.json").unlink(missing_ok=True)


def note_slurm_job(run: Run, job: str) -> None:
    """Notes which Slurm job will do the run."""
    run.folder.mkdir(parents=True, exist_ok=True)
    write_atomically(run.folder / "slurm_job", job.encode())


def slurm_job(run: Run) -> str | None:
    """Returns the Slurm job that was submitted for the run last."""
    try:
        return (run.folder / "slurm_job").read_text()
    except OSError:
        return None


def last_lines(run: Run, number: int) -> list[str]:
    """Returns the end of the run's log."""
    try:
        return _tail(run.folder / "log.txt").splitlines()[-number:]
    except OSError:
        return []


def _state(run: Run, queued: frozenset[str]) -> State:
    if is_in_use(run):
        return State.RUNNING
    if is_finished(run):
        return State.FINISHED
    if failure(run) is not None:
        return State.FAILED
    if slurm_job(run) in queued:
        return State.QUEUED
    begun = (run.folder / "config.json").exists()
    return State.PARTLY_DONE if begun else State.MISSING


def _is_locked(path: pathlib.Path) -> bool:
    try:
        with path.open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _last_row(path: pathlib.Path) -> dict[str, str]:
    """Returns the last whole row of a table by column, without empty cells."""
    try:
        with path.open() as file:
            header = file.readline()
        tail = _tail(path)
    except OSError:
        return {}
    # A row counts once its line has an end; a table's first line is the header.
    lines = tail[: tail.rfind("\n") + 1].splitlines()
    if not lines or lines[-1] == header.rstrip("\n"):
        return {}
    columns, row = csv.reader([header, lines[-1]])
    return {name: cell for name, cell in zip(columns, row) if cell}


def _tail(path: pathlib.Path) -> str:
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - _TAIL_BYTES, 0))
        return file.read().decode(errors="replace")
