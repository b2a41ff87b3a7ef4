"""What does the runs of a sweep, one after the other: the function of each job.

Each run is a process of its own, the ordinary command, so that neither its crash nor
its leftover memory touches the next one.
"""

import contextlib
import dataclasses
import enum
import os
import pathlib
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import IO, Any

from launch.sweeps import state
from launch.sweeps.plan import Run
from launch.sweeps.process import Process

_POLL_SECONDS = 0.2
_IDLE_SECONDS = 2.0
# What jaxil.launch says to the first request to stop; a second one ends it unsaved.
HAS_HEARD = "once more ends at once"
_HEARING_SECONDS = 3.0
# After SIGTERM, Slurm either kills the job or lets submitit requeue it.
_VERDICT_SECONDS = 600.0
_STOPPED_STATUS = 130  # of jaxil.launch, when someone asked it to stop
_WRONG_USE_STATUS = 2
_IN_USE = "is in use by another process"


class _Outcome(enum.Enum):
    ENDED = enum.auto()  # finished or failed: nothing left to do here
    HELD = enum.auto()  # someone else has it
    STOPPED = enum.auto()


@dataclasses.dataclass(frozen=True)
class Place:
    """The share of a machine that a worker's runs get.

    Attributes:
      cores: numbers of CPU cores; None for all that the job was given.
      environment: variables to be set.
    """

    cores: tuple[int, ...] | None = None
    environment: tuple[tuple[str, str], ...] = ()


class Worker:
    """Takes runs from a list that other workers share, until none is left.

    A pickled instance is the job that submitit starts; it restarts a requeued one with
    what `checkpoint` returns.
    """

    def __init__(
        self,
        runs: list[Run],
        place: Place,
        *,
        folder: pathlib.Path,
        leader: Process | None = None,
        patience_seconds: float = float("inf"),
    ) -> None:
        """Prepares.

        Args:
          runs: to be done; finished and failed ones are passed over.
          place: where.
          folder: that the commands are seen from.
          leader: the worker stops when this process has ended.
          patience_seconds: how long to wait for runs that others have: they may leave
            them unfinished.
        """
        self._runs = runs
        self._place = place
        self._folder = folder
        self._leader = leader
        self._patience_seconds = patience_seconds
        self._signal: int | None = None
        self._pause: float = 0.0

    def __call__(self) -> None:
        """Does the runs."""
        if self._place.cores is not None:
            os.sched_setaffinity(0, self._place.cores)
        with self._listening() as requeue:
            self._work()
            if self._signal is not None and requeue is not None:
                self._await_verdict()
                if self._signal != signal.SIGTERM:
                    requeue(self._signal, None)

    def checkpoint(self) -> Any:
        """Returns the job that goes on in place of this one; submitit asks for it."""
        from submitit.helpers import DelayedSubmission

        self._signal = None
        return DelayedSubmission(self)

    def _work(self) -> None:
        left = list(self._runs)
        last_change = time.monotonic()
        while left:
            still_left = []
            for run in left:
                outcome = self._do(run)
                if outcome is _Outcome.STOPPED:
                    return
                if outcome is _Outcome.HELD:
                    still_left.append(run)
            if len(still_left) < len(left):
                last_change = time.monotonic()
            elif time.monotonic() - last_change > self._patience_seconds:
                return
            left = still_left
            if left:
                time.sleep(_IDLE_SECONDS)
                if self._has_to_stop():
                    return

    def _do(self, run: Run) -> _Outcome:
        if self._has_to_stop():
            return _Outcome.STOPPED
        if state.is_finished(run):
            return _Outcome.ENDED
        with state.claimed(run) as claim:
            # Another worker may have come first.
            if claim is None:
                return _Outcome.HELD
            if state.is_finished(run) or state.failure(run) is not None:
                return _Outcome.ENDED
            return self._train(run, claim)

    def _train(self, run: Run, claim: IO[str]) -> _Outcome:
        with (run.folder / "log.txt").open("a") as log:
            log.write(f"\n{time.strftime('%F %T')} $ {' '.join(run.command)}\n")
            log.flush()
            begin = log.tell()
            process = subprocess.Popen(
                # Slurm may send a job's signals to all of its processes; what means
                # "requeue" to this one would kill that one.
                ["sh", "-c", 'trap "" USR1 USR2; exec "$@"', "sh", *run.command],
                cwd=self._folder,
                env={**os.environ, **_thread_limits(), **dict(self._place.environment)},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # A terminal's Ctrl-C is for the sweep, which then asks once.
                start_new_session=True,
                pass_fds=[claim.fileno()],
            )
            try:
                exit_status = self._wait(process, run, begin)
            except BaseException:  # Ctrl-C, where no job stands between
                process.terminate()
                process.wait()
                raise
        stopped = self._has_to_stop() or exit_status == _STOPPED_STATUS
        if exit_status == 0 or (stopped and not _is_own_fault(exit_status)):
            return _Outcome.STOPPED if self._has_to_stop() else _Outcome.ENDED
        if exit_status == _WRONG_USE_STATUS and _IN_USE in _read(run, begin):
            return _Outcome.HELD
        state.note_failure(run, exit_status)
        return _Outcome.ENDED

    def _wait(self, process: subprocess.Popen, run: Run, begin: int) -> int:
        """Waits for a run's process; asks it to save and end when it is time to."""
        asked = False
        while True:
            try:
                return process.wait(_POLL_SECONDS)
            except subprocess.TimeoutExpired:
                pass
            if asked or not self._has_to_stop():
                continue
            asked = True
            # Slurm may have told the process too, or only this one: it depends on
            # the cluster. One request saves, two don't.
            time.sleep(self._pause)
            if HAS_HEARD not in _read(run, begin):
                process.terminate()

    def _has_to_stop(self) -> bool:
        return self._signal is not None or (
            self._leader is not None and not self._leader.is_alive()
        )

    @contextlib.contextmanager
    def _listening(self) -> Iterator[Callable[[int, Any], Any] | None]:
        """Notes signals instead of acting on them at once.

        Yields:
          What submitit would have done about a request to requeue; None where it
          offers no such thing.
        """
        if "SUBMITIT_EXECUTOR" not in os.environ:  # in the sweep's own process
            yield None
            return
        from submitit.core.job_environment import JobEnvironment

        requeue_signal = JobEnvironment._usr_sig()
        numbers = (signal.SIGTERM, requeue_signal)
        before = {number: signal.signal(number, self._note) for number in numbers}
        is_slurm = os.environ["SUBMITIT_EXECUTOR"] == "slurm"
        self._pause = _HEARING_SECONDS if is_slurm else 0.0
        try:
            requeue = before[requeue_signal]
            yield requeue if is_slurm and callable(requeue) else None
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, frame: Any) -> None:
        del frame
        # A request to requeue outweighs SIGTERM, which comes along with it.
        if self._signal in (None, signal.SIGTERM):
            self._signal = number

    def _await_verdict(self) -> None:
        end = time.monotonic() + _VERDICT_SECONDS
        while self._signal == signal.SIGTERM and time.monotonic() < end:
            time.sleep(_POLL_SECONDS)


def _is_own_fault(exit_status: int) -> bool:
    """Says whether a process that was asked to stop ended for a reason of its own."""
    asked = (_STOPPED_STATUS, -signal.SIGTERM, -signal.SIGINT, -signal.SIGKILL)
    return exit_status not in (0, *asked)


def _thread_limits() -> dict[str, str]:
    # XLA counts the cores that it may use; these libraries count all.
    cores = str(len(os.sched_getaffinity(0)))
    return {"OMP_NUM_THREADS": cores, "OPENBLAS_NUM_THREADS": cores}


def _read(run: Run, begin: int) -> str:
    with (run.folder / "log.txt").open("rb") as log:
        log.seek(begin)
        return log.read().decode(errors="replace")
