"""The worker, which does runs of a sweep one after the other.

Each run is a process of its own, the ordinary command, so that neither its crash nor
its leftover memory touches the next one.
"""

import contextlib
import dataclasses
import os
import pathlib
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

from jaxil.files import locking
from jaxil.sweeps import state
from jaxil.sweeps.state import Run

_ROOT = pathlib.Path(__file__).parents[2]  # where the package is
_POLL_SECONDS = 0.2
_IDLE_SECONDS = 2.0
_ENDING_SECONDS = 60.0  # from a run's last checkpoint to the end of its process
_STOPPED_STATUS = 130  # of jaxil.launch, when someone asked it to stop
_WRONG_USE_STATUS = 2
# A run is asked to stop by SIGHUP, which is harmless if it was asked before: a second
# one of the other signals ends it unsaved. The starter makes SIGHUP work under nohup
# and has the kernel send it when the worker dies (1 is PR_SET_PDEATHSIG). It ignores
# Slurm's warnings, which tell a worker to requeue but would kill the run.
_STARTER = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGHUP)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
for number in (signal.SIGUSR1, signal.SIGUSR2):
    signal.signal(number, signal.SIG_IGN)
os.execvp(sys.argv[1], sys.argv[1:])
"""


class Place(NamedTuple):
    """The share of a machine that a worker's runs get."""

    cores: tuple[int, ...] = ()  # empty for all that there are
    environment: tuple[tuple[str, str], ...] = ()  # variables to set


@dataclasses.dataclass(eq=False)
class Worker:
    """Takes runs from a list that other workers share, until none is left."""

    runs: Sequence[Run]  # finished and failed ones are skipped
    place: Place
    folder: pathlib.Path  # where the commands are run
    patience_seconds: float = float("inf")  # of waiting for runs that others have
    must_stop: bool = False  # set it to save the current run and end the worker
    has_ended: bool = False
    pause_seconds: ClassVar[float] = 0.0  # before a run is asked to stop

    def work(self) -> None:
        """Does the runs."""
        try:
            if self.place.cores:  # of this thread, and of what it starts
                os.sched_setaffinity(0, self.place.cores)
            self._work()
        finally:
            self.has_ended = True

    def _work(self) -> None:
        left = list(self.runs)
        last_change = time.monotonic()
        while left and not self.must_stop:
            held = [run for run in left if self.must_stop or not self._do(run)]
            if len(held) < len(left):
                last_change = time.monotonic()
            elif time.monotonic() - last_change > self.patience_seconds:
                return
            left = held
            if left and not self.must_stop:
                time.sleep(_IDLE_SECONDS)

    def _do(self, run: Run) -> bool:
        """Trains a run; returns False if another process has it and may abandon it."""
        if state.damage(run):
            return True
        if state.is_finished(run):
            end = time.monotonic() + _ENDING_SECONDS  # it may write its last video
            while state.is_in_use(run) and not self.must_stop:
                if time.monotonic() > end:  # someone trains it for longer
                    break
                time.sleep(_IDLE_SECONDS)
            return True
        try:
            run.folder.mkdir(parents=True, exist_ok=True)
            with locking.locked(run.folder / "claim"):
                # Another worker may have come first.
                if state.is_finished(run) or state.failure(run) is not None:
                    return True
                return not locking.is_locked(run.folder / "lock") and self._train(run)
        except locking.InUseError:
            return False
        except OSError as error:
            print(f"{run.name} cannot be started: {error}", file=sys.stderr)
            return True

    def _train(self, run: Run) -> bool:
        cores = str(len(os.sched_getaffinity(0)))
        # XLA counts the cores that it may use; these libraries count all.
        limits = {"OMP_NUM_THREADS": cores, "OPENBLAS_NUM_THREADS": cores}
        path = {"PYTHONPATH": python_path()}
        with (run.folder / "log.txt").open("a") as log:
            log.write(f"\n{time.strftime('%F %T')} $ {' '.join(run.command)}\n")
            log.flush()
            process = subprocess.Popen(
                [sys.executable, "-IS", "-c", _STARTER, *run.command],
                cwd=self.folder,
                env={**os.environ, **path, **limits, **dict(self.place.environment)},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # A terminal's Ctrl-C is for the sweep, which then asks once.
                start_new_session=True,
            )
            exit_status = self._wait(process)
        killed = (-signal.SIGHUP, -signal.SIGTERM, -signal.SIGINT, -signal.SIGKILL)
        was_stopped = self.must_stop and exit_status in killed
        if exit_status in (0, _STOPPED_STATUS) or was_stopped or state.is_finished(run):
            return True
        if exit_status == _WRONG_USE_STATUS and locking.is_locked(run.folder / "lock"):
            return False  # someone has started it by hand at the same time
        state.note_failure(run, exit_status)
        return True

    def _wait(self, process: subprocess.Popen) -> int:
        """Waits for a run's process, and asks it to stop once `must_stop` is set."""
        asked = False
        while True:
            with contextlib.suppress(subprocess.TimeoutExpired):
                return process.wait(_POLL_SECONDS)
            if self.must_stop and not asked:
                asked = True
                time.sleep(self.pause_seconds)
                process.send_signal(signal.SIGHUP)


def python_path() -> str:
    """Returns a PYTHONPATH with which processes in any folder find this project."""
    before = os.environ.get("PYTHONPATH", "")
    # An installed package is found anyway; its folder must not come before Python's.
    own = "" if pathlib.Path(sysconfig.get_path("purelib")) == _ROOT else str(_ROOT)
    return os.pathsep.join(each for each in (own, before) if each)
