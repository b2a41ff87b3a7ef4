"""Where the runs of a sweep are done: this machine, or Slurm.

A Slurm job resumes where it was cut off; the jobs of a sweep make an array.
"""

import getpass
import glob
import importlib.util
import os
import pathlib
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from jaxil.errors import Fault, UsageError, unknown_name
from jaxil.machine import devices
from jaxil.sweeps import state
from jaxil.sweeps.state import Run
from jaxil.sweeps.worker import Place, Worker, python_path

CLUSTERS = ("local", "slurm", "debug")
_POLL_SECONDS = 0.5
_JAX_MEMORY = 0.9  # of a GPU that several runs share
# Slurm's default MaxArraySize allows no larger index.
_ARRAY_SIZE = 1000
_REQUEUES = 1000  # on timeouts: a run is worth resuming until it is done
# How long before the time limit a run is asked to save: a checkpoint takes seconds, but
# an agent step that waits for a compilation takes a minute.
_SAVING_SECONDS = 120
_ANSWER_SECONDS = 60
_PATIENCE_SECONDS = 300.0  # file locks of a crashed node last a while
# After SIGTERM, Slurm either kills the job or lets submitit requeue it.
_VERDICT_SECONDS = 600.0


_SLURM_FLAGS = {
    "hours": "--hours",
    "partition": "--partition",
    "num_gpus": "--gpus",
    "num_cpus": "--cpus",
}


class Cluster(NamedTuple):
    """Where to run, unchecked."""

    name: str
    num_workers: int | None = None  # runs at a time here; None for as many as fit
    hours: float = 24.0  # time limit of a Slurm job, which is then queued again
    partition: str = ""  # of Slurm; "" for its default
    num_gpus: int = 1  # of a Slurm job
    num_cpus: int = 4  # of a Slurm job

    @property
    def uses_gpus(self) -> bool:
        """Whether runs will compute on GPUs, told without starting jax."""
        return self.num_gpus > 0 if self.name == "slurm" else not devices.uses_cpu()


def problems(cluster: Cluster, *, starts: bool) -> Iterator[Fault]:
    """Yields why a cluster cannot do runs, or if not `starts`, cannot show them."""
    if cluster.name not in CLUSTERS:
        yield unknown_name("--cluster", cluster.name, CLUSTERS)
    if starts and cluster.name == "slurm":
        if importlib.util.find_spec("submitit") is None:
            rule = "starts jobs with submitit, which is not installed"
            way_out = "pip install submitit, or use --cluster=local"
            yield Fault("--cluster", rule, way_out, "slurm")
        if fault := _slurm_fault():
            way_out = "run this on a login node of your cluster, or use --cluster=local"
            yield Fault("--cluster", f"finds no Slurm here: {fault}", way_out, "slurm")
    most = len(os.sched_getaffinity(0))
    if cluster.num_workers is not None and cluster.name in ("slurm", "debug"):
        rule, way_out = "is for --cluster=local", "leave it out"
        yield Fault("--workers", rule, way_out, cluster.num_workers)
    elif cluster.num_workers is not None and not 1 <= cluster.num_workers <= most:
        rule = f"must lie in [1, {most}]: a run needs a core, and there are {most}"
        yield Fault("--workers", rule, value=cluster.num_workers)
    if cluster.name in CLUSTERS and cluster.name != "slurm":
        for field, flag in _SLURM_FLAGS.items():
            value = getattr(cluster, field)
            if value != Cluster._field_defaults[field]:
                yield Fault(flag, "is for --cluster=slurm", "add that", value)
    if not 0.0 < cluster.hours <= 10_000.0:
        rule = "must lie in (0, 10000]: the time limit of a Slurm job"
        yield Fault("--hours", rule, value=cluster.hours)
    if cluster.num_gpus not in (0, 1):
        rule = "must be 0 or 1: a run uses one device"
        yield Fault("--gpus", rule, value=cluster.num_gpus)
    if not 1 <= cluster.num_cpus <= 1024:
        rule = "must lie in [1, 1024]: cores of a Slurm job"
        yield Fault("--cpus", rule, value=cluster.num_cpus)


def num_at_once(cluster: Cluster, num_runs: int) -> int:
    """Returns how many runs go on at a time at most."""
    return num_runs if cluster.name == "slurm" else len(places(cluster, num_runs))


def places(cluster: Cluster, num_runs: int) -> list[Place]:
    """Returns a share of this machine for each worker."""
    if cluster.name == "debug":
        return [Place()]
    cores = sorted(os.sched_getaffinity(0))
    gpus = _gpus()
    fitting = 1 if cluster.uses_gpus else len(cores)
    number = min(cluster.num_workers or len(gpus) or fitting, num_runs)
    share = len(cores) // max(number, 1)
    made = []
    for i in range(number):
        environment = []
        if gpus:
            environment.append(("CUDA_VISIBLE_DEVICES", gpus[i % len(gpus)]))
        if gpus and number > len(gpus):
            fraction = _JAX_MEMORY / -(-number // len(gpus))
            environment.append(("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{fraction:.2f}"))
        made.append(Place(tuple(cores[i * share : (i + 1) * share]), (*environment,)))
    return made


def start(
    cluster: Cluster,
    runs: Sequence[Run],
    folder: pathlib.Path,
    watch: Callable[[], None],
) -> None:
    """Does at least one run of a sweep's folder; on Slurm, only submits them.

    `watch` is called now and then while runs go on here.

    Raises:
      KeyboardInterrupt: the sweep was stopped; by then all runs have saved and ended.
    """
    for run in runs:
        state.forget_failure(run)
    if cluster.name == "slurm":
        submit(cluster, runs, folder / ".sweep")
        return
    here = pathlib.Path.cwd()
    shares = places(cluster, len(runs))
    workers = [Worker(runs, place, here) for place in shares]
    for worker in workers:
        # Daemons, so that a second Ctrl-C ends the sweep; its runs still save then.
        threading.Thread(target=worker.work, daemon=True).start()

    def wait(watch: Callable[[], None]) -> None:
        # Not Thread.join: an exception during it marks the thread as ended.
        while not all(worker.has_ended for worker in workers):
            watch()
            time.sleep(_POLL_SECONDS)

    try:
        wait(watch)
    except KeyboardInterrupt:
        for worker in workers:
            worker.must_stop = True
        wait(lambda: None)
        raise


class Job(Worker):
    """One Slurm job: a pickled instance is what submitit calls on the node."""

    # On some clusters Slurm signals the run too, on others only this process. After the
    # pause, a run that got its own signal is saving already and ignores SIGHUP.
    pause_seconds = 3.0

    def __call__(self) -> None:
        """Does its run; requeues it when Slurm warns that it will end the job."""
        from submitit.core.job_environment import JobEnvironment

        requeue_signal = JobEnvironment._usr_sig()
        self._signal = 0
        requeue: Any = signal.signal(requeue_signal, self._note)
        signal.signal(signal.SIGTERM, self._note)
        self.work()
        end = time.monotonic() + _VERDICT_SECONDS
        while self._signal == signal.SIGTERM and time.monotonic() < end:
            time.sleep(_POLL_SECONDS)
        if self._signal == requeue_signal:
            requeue(self._signal, None)

    def checkpoint(self) -> Any:
        """Returns the job that resumes this one; submitit asks for it."""
        from submitit.helpers import DelayedSubmission

        self.must_stop = False
        return DelayedSubmission(self)

    def _note(self, number: int, frame: Any) -> None:
        del frame
        self.must_stop = True
        # A request to requeue outweighs SIGTERM, which comes along with it.
        if self._signal in (0, signal.SIGTERM):
            self._signal = number


def submit(cluster: Cluster, runs: Sequence[Run], logs: pathlib.Path) -> None:
    """Queues one job for each run; a site's further needs go in SBATCH_... variables.

    Their commands are run in the current folder. All nodes must see the folder `logs`,
    where submitit writes.

    Raises:
      UsageError: Slurm refuses them, for its partition, say.
    """
    import submitit
    from submitit.core.utils import FailedJobError

    minutes = max(round(cluster.hours * 60), 1)
    executor = submitit.SlurmExecutor(logs, max_num_timeout=_REQUEUES)
    executor.update_parameters(
        job_name="jaxil",
        time=minutes,
        cpus_per_task=cluster.num_cpus,
        # srun no longer inherits it from sbatch.
        srun_args=[f"--cpus-per-task={cluster.num_cpus}"],
        signal_delay_s=min(_SAVING_SECONDS, 15 * minutes),
        setup=[f"export PYTHONPATH={shlex.quote(python_path())}"],
        additional_parameters={"requeue": True},
        **({"partition": cluster.partition} if cluster.partition else {}),
        **({"gpus_per_node": cluster.num_gpus} if cluster.num_gpus else {}),
    )
    here = pathlib.Path.cwd()
    for first in range(0, len(runs), _ARRAY_SIZE):
        some = runs[first : first + _ARRAY_SIZE]
        jobs = [Job([run], Place(), here, _PATIENCE_SECONDS) for run in some]
        try:
            submitted = executor.submit_array(jobs)
        except FailedJobError as error:
            rule = f"finds that Slurm refuses jobs: {error}"
            raise UsageError(Fault("--cluster", rule, value="slurm")) from error
        for run, job in zip(some, submitted, strict=True):
            state.note_slurm_job(run, job.job_id)


def queued_jobs(runs: Sequence[Run]) -> frozenset[str]:
    """Returns which Slurm jobs of this user wait or run; none if no run has one."""
    has_jobs = any(os.path.exists(run.folder / "slurm_job") for run in runs)
    if not has_jobs or shutil.which("squeue") is None:
        return frozenset()
    try:
        user = f"--user={getpass.getuser()}"
        listed = _output("squeue", "--noheader", "--array", "--format=%i", user)
    except (subprocess.SubprocessError, OSError, KeyError):  # of a user without a name
        return frozenset()  # without it a run may be queued twice, but not done twice
    return frozenset(listed.split())


def _gpus() -> list[str]:
    """Returns the NVIDIA devices that jax may use, as CUDA names them."""
    if devices.uses_cpu() or not devices.has_cuda_device():
        return []
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name.strip() for name in chosen.split(",")]
    return [str(i) for i in range(len(glob.glob("/dev/nvidia[0-9]*")) or 1)]


def _slurm_fault() -> str | None:
    """Returns why no job can be queued from here; None if one can."""
    for command in ("sbatch", "srun"):
        if shutil.which(command) is None:
            return f"there is no command {command}"
    try:
        _output("sinfo", "--noheader")
    except subprocess.CalledProcessError as error:
        said = error.stderr.strip().splitlines()
        return f"sinfo fails ({said[-1] if said else error.returncode})"
    except (subprocess.SubprocessError, OSError) as error:
        return f"sinfo fails ({error})"
    return None


def _output(*arguments: str) -> str:
    return subprocess.run(
        arguments, check=True, capture_output=True, text=True, timeout=_ANSWER_SECONDS
    ).stdout
