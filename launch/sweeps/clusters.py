"""Where the runs of a sweep are done: this machine, this process, or Slurm."""

import contextlib
import dataclasses
import glob
import importlib.util
import os
import pathlib
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from jaxil.config import unknown_name
from jaxil.machine import devices
from launch.sweeps import plan, slurm, state
from launch.sweeps.process import Process
from launch.sweeps.worker import Place, Worker

CLUSTERS = ("local", "slurm", "debug")
_POLL_SECONDS = 1.0
_A_YEAR_MINUTES = 365 * 24 * 60  # submitit must be told some limit
_JAX_MEMORY = 0.9  # of a GPU that several runs share


@dataclasses.dataclass(frozen=True)
class Cluster:
    """Where to run, unchecked.

    Attributes:
      name: one of `CLUSTERS`.
      num_workers: runs at a time, on this machine; None for as many as fit.
      hours: time limit of a Slurm job, after which it is queued again.
      partition: of Slurm; "" for its default.
      num_gpus: of a Slurm job.
      num_cpus: of a Slurm job.
    """

    name: str
    num_workers: int | None = None
    hours: float = 24.0
    partition: str = ""
    num_gpus: int = 1
    num_cpus: int = 4


def problems(cluster: Cluster, *, starts: bool) -> Iterator[str]:
    """Yields one sentence for each reason why a cluster can't be used.

    Args:
      cluster: unchecked.
      starts: whether runs will be started, or only shown.
    """
    if cluster.name not in CLUSTERS:
        yield unknown_name("--cluster", cluster.name, CLUSTERS)
    has_submitit = importlib.util.find_spec("submitit") is not None
    if starts and cluster.name in ("local", "slurm") and not has_submitit:
        yield (
            f"--cluster={cluster.name!r} starts jobs with submitit, which is not "
            "installed: pip install 'jaxil[cluster]', or use --cluster=debug"
        )
    if starts and cluster.name == "slurm" and (fault := slurm.fault()):
        yield (
            f"--cluster='slurm': no Slurm here: {fault}; run this on a login node of "
            "your cluster, or use --cluster=local"
        )
    most = len(os.sched_getaffinity(0))
    if cluster.num_workers is not None and not 1 <= cluster.num_workers <= most:
        yield (
            f"--workers={cluster.num_workers} must lie in [1, {most}]: a run needs a "
            f"core, and this machine has {most}"
        )
    if not 0.0 < cluster.hours <= 10_000.0:
        yield f"--hours={cluster.hours} must lie in (0, 10000]: a Slurm job's limit"
    if cluster.num_gpus not in (0, 1):
        yield f"--gpus={cluster.num_gpus} must be 0 or 1: a run uses one device"
    if not 1 <= cluster.num_cpus <= 1024:
        yield f"--cpus={cluster.num_cpus} must lie in [1, 1024]: cores of a Slurm job"


def uses_gpus(cluster: Cluster) -> bool:
    """Returns whether runs will compute on GPUs, told without starting jax."""
    if cluster.name == "slurm":
        return cluster.num_gpus > 0
    return not devices.uses_cpu()


def num_at_once(cluster: Cluster, num_runs: int) -> int:
    """Returns how many runs go on at a time, at most."""
    if cluster.name == "slurm":
        return num_runs
    return len(places(cluster, num_runs))


def places(cluster: Cluster, num_runs: int) -> list[Place]:
    """Returns a share of this machine for each local worker."""
    cores = sorted(os.sched_getaffinity(0))
    gpus = _gpus()
    if cluster.name == "debug":
        return [Place()]
    fitting = 1 if uses_gpus(cluster) else len(cores)
    number = min(cluster.num_workers or len(gpus) or fitting, num_runs)
    share = len(cores) // max(number, 1)
    made = []
    for i in range(number):
        environment = []
        if gpus:
            environment.append(("CUDA_VISIBLE_DEVICES", gpus[i % len(gpus)]))
        if gpus and number > len(gpus):
            runs_per_gpu = -(-number // len(gpus))
            fraction = f"{_JAX_MEMORY / runs_per_gpu:.2f}"
            environment.append(("XLA_PYTHON_CLIENT_MEM_FRACTION", fraction))
        own = tuple(cores[i * share : (i + 1) * share])
        made.append(Place(cores=own, environment=tuple(environment)))
    return made


def start(
    cluster: Cluster,
    runs: Sequence[plan.Run],
    folder: pathlib.Path,
    watch: Callable[[], None],
) -> None:
    """Has the runs done; on Slurm, only submits them.

    Args:
      cluster: checked.
      runs: what is left to do, at least one.
      folder: of the sweep.
      watch: called now and then while runs go on here.

    Raises:
      KeyboardInterrupt: the sweep was stopped; by then all runs have saved and ended.
    """
    for run in runs:
        state.forget_failure(run)
    logs = folder / ".sweep"
    here = pathlib.Path.cwd()
    if cluster.name == "debug":
        # submitit's own executor of this name would open a debugger.
        Worker(list(runs), Place(), folder=here)()
        return
    with _importable():
        if cluster.name == "slurm":
            slurm.submit(
                runs,
                logs=logs,
                folder=here,
                hours=cluster.hours,
                partition=cluster.partition,
                num_gpus=cluster.num_gpus,
                num_cpus=cluster.num_cpus,
            )
        else:
            workers = [
                Worker(list(runs), place, folder=here, leader=Process.current())
                for place in places(cluster, len(runs))
            ]
            _lead(workers, logs, watch)


def _lead(workers: list[Worker], logs: pathlib.Path, watch: Callable[[], None]) -> None:
    """Starts local workers and stays with them."""
    import submitit

    executor = submitit.LocalExecutor(logs)
    executor.update_parameters(timeout_min=_A_YEAR_MINUTES)
    # The workers inherit this: Ctrl-C reaches them through this process only, since
    # submitit answers it with SIGKILL.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        jobs = [executor.submit(worker) for worker in workers]
    finally:
        signal.signal(signal.SIGINT, before)
    try:
        _wait(jobs, watch)
    except KeyboardInterrupt:
        for job in jobs:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(job.job_id), signal.SIGTERM)  # passed on to the worker
        _wait(jobs, lambda: None)
        raise


def _wait(jobs: Sequence[Any], watch: Callable[[], None]) -> None:
    while not all(job.done() for job in jobs):
        watch()
        time.sleep(_POLL_SECONDS)


def _gpus() -> list[str]:
    """Returns the NVIDIA devices that jax may use, as CUDA names them."""
    if devices.uses_cpu() or not devices.has_cuda_device():
        return []
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name.strip() for name in chosen.split(",")]
    return [str(i) for i in range(len(glob.glob("/dev/nvidia[0-9]*")) or 1)]


@contextlib.contextmanager
def _importable() -> Iterator[None]:
    """Lets the jobs' processes find this package, wherever they are started."""
    before = os.environ.get("PYTHONPATH")
    parts = [str(plan.ROOT), *([before] if before else [])]
    os.environ["PYTHONPATH"] = os.pathsep.join(parts)
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before
