"""How far a run has come, judged by its folder alone.

Nothing else remembers a sweep, so it can be killed anywhere, watched from elsewhere and
started again. Beside what `jaxil.launch` writes, a run's folder holds

    log.txt      what its processes have printed
    claim        locked while a worker has the run
    failed.json  exit status of a process that failed
    slurm_job    number of the Slurm job that waits for it or runs it
"""

import contextlib
import csv
import enum
import functools
import json
import math
import os
import pathlib
from typing import NamedTuple

from jaxil.errors import UsageError, printable
from jaxil.files import locking
from jaxil.files.untrusted import open_regular, read_regular
from jaxil.files.writing import write_atomically
from jaxil.reporting import runs
from jaxil.training import workdir

_TAIL_BYTES = 16_384  # holds many rows of a table, and the last lines of a log
_COLUMNS = ("frame", "seconds", "task_return_mean")  # read from tables


class Run(NamedTuple):
    """One run of a sweep: what it takes to train it and to find its results."""

    task: str
    slug: str  # of the variant
    method: str
    seed: int
    folder: pathlib.Path  # DIR/TASK/SLUG/seedN
    total_frames: int
    command: tuple[str, ...]  # trains or resumes it

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.task}/{self.slug}/seed{self.seed}"


class State(enum.StrEnum):
    """What has to be done about a run."""

    RUNNING = "running"
    FAILED = "failed"
    DAMAGED = "damaged"  # a file of it cannot be read
    QUEUED = "queued"
    PARTLY_DONE = "partly done"
    MISSING = "missing"
    FINISHED = "finished"


class Status(NamedTuple):
    """A run, looked at."""

    state: State
    frame: int = 0  # the last one in its tables
    seconds: float = 0.0  # up to that frame, evaluations included
    last_return: float | None = None  # None before the first evaluation

    @property
    def frames_per_second(self) -> float | None:
        """Mean speed of the whole run; None before its first episode."""
        return self.frame / self.seconds if self.frame and self.seconds else None


def status(run: Run, queued: frozenset[str] = frozenset()) -> Status:
    """Looks at a run, which need not have begun; cheap, however long its tables are.

    `queued` are the Slurm jobs that wait or run.
    """
    try:
        training = _last_row(run.folder / "train.csv")
        evaluation = _last_row(run.folder / "eval.csv")
    except ValueError:
        state = _state(run, queued)
        is_open = state in (State.PARTLY_DONE, State.MISSING)
        return Status(State.DAMAGED if is_open else state)
    return Status(
        state=_state(run, queued),
        frame=int(training.get("frame", 0)),
        seconds=training.get("seconds", 0.0),
        last_return=evaluation.get("task_return_mean"),
    )


def is_finished(run: Run) -> bool:
    """Returns whether the budget is used up.

    The newest checkpoint decides, as it does for `jaxil.launch`: it is written after
    the last rows. Where someone has removed the checkpoints, the tables do.
    """
    frame: float | None = workdir.newest_checkpoint(run.folder)
    if frame is None:
        tables = (run.folder / name for name in ("train.csv", "eval.csv"))
        try:
            frame = min(_last_row(table).get("frame", 0) for table in tables)
        except ValueError:
            return False
    return frame >= run.total_frames


def is_in_use(run: Run) -> bool:
    """Returns whether a worker has the run, or someone who started it by hand."""
    # In this order: looking at a lock holds it for a moment, and a process that a
    # worker has just started must not find its own lock held.
    return any(locking.is_locked(run.folder / name) for name in ("claim", "lock"))


def damage(run: Run) -> str:
    """Returns why a run cannot be resumed; "" if it can.

    A damaged table is no reason: `jaxil.launch` sets it aside.
    """
    try:
        written = (run.folder / "config.json").stat().st_mtime_ns
    except FileNotFoundError:
        orphaned = workdir.newest_checkpoint(run.folder) is not None
        return f"{run.folder} has checkpoints but no config.json" if orphaned else ""
    except OSError as error:
        return f"{run.folder} is not readable ({error.strerror})"
    return _config_damage(run.folder, written)


def note_failure(run: Run, exit_status: int) -> None:
    """Notes that the run's process has failed."""
    content = {"exit_status": exit_status, "command": list(run.command)}
    write_atomically(run.folder / "failed.json", json.dumps(content).encode())


def failure(run: Run) -> int | None:
    """Returns the exit status that `note_failure` noted; None without."""
    return runs.exit_status(run.folder)


def forget_failure(run: Run) -> None:
    """Lets workers try the run again."""
    with contextlib.suppress(OSError):
        (run.folder / "failed.json").unlink()


def note_slurm_job(run: Run, job: str) -> None:
    """Notes which Slurm job will do the run."""
    run.folder.mkdir(parents=True, exist_ok=True)
    write_atomically(run.folder / "slurm_job", job.encode())


def slurm_job(run: Run) -> str | None:
    """Returns the Slurm job that was submitted for the run last."""
    try:
        return read_regular(run.folder / "slurm_job").decode()
    except (OSError, ValueError):
        return None


def last_lines(run: Run, number: int) -> list[str]:
    """Returns the end of the run's log."""
    try:
        lines = _tail(run.folder / "log.txt").splitlines()[-number:]
        return [printable(line) for line in lines]
    except OSError:
        return []


def _state(run: Run, queued: frozenset[str]) -> State:
    if damage(run):
        return State.DAMAGED
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


@functools.cache
def _config_damage(folder: pathlib.Path, written: int) -> str:
    """Reads a config once for each time at which it was written."""
    del written
    try:
        workdir.read_config(folder)
    except UsageError as error:
        return str(error)
    return ""


def _last_row(path: pathlib.Path) -> dict[str, float]:
    """Returns the numbers of a table's last whole row, without empty cells.

    Raises:
      ValueError: it is no table, or a number is not finite.
    """
    try:
        with open_regular(path) as file:
            header = file.readline(_TAIL_BYTES).decode(errors="replace")
        # A row counts once its line has an end: what follows the last one is cut off.
        *lines, _ = _tail(path).split("\n")
    except OSError:
        return {}
    if not lines:
        return {}
    try:
        columns, row = csv.reader([header, lines[-1]])
        cells = dict(zip(columns, row, strict=True))
    except csv.Error as error:
        raise ValueError(error) from error
    if cells.get("frame") == "frame":  # the header itself
        return {}
    numbers = {name: float(cells[name]) for name in _COLUMNS if cells.get(name)}
    if "frame" not in numbers or not all(map(math.isfinite, numbers.values())):
        raise ValueError("the last row has no frame, or numbers that are not finite")
    return numbers


def _tail(path: pathlib.Path) -> str:
    with open_regular(path) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - _TAIL_BYTES, 0))
        return file.read().decode(errors="replace")
