"""Runs as Slurm jobs: an array of them, each going on where it was cut off."""

import getpass
import pathlib
import shutil
import subprocess
from collections.abc import Sequence

from launch.sweeps import state
from launch.sweeps.plan import Run
from launch.sweeps.worker import Place, Worker

# Slurm's default MaxArraySize allows no larger index.
_ARRAY_SIZE = 1000
_REQUEUES = 1000  # on timeouts: a run is worth going on with until it is done
# How long before the time limit a run is asked to save: a checkpoint takes seconds,
# a decision that waits for a compilation a minute.
_SAVING_SECONDS = 120
_ANSWER_SECONDS = 60
_PATIENCE_SECONDS = 300.0  # file locks of a node that broke down last a while


def submit(
    runs: Sequence[Run],
    *,
    logs: pathlib.Path,
    folder: pathlib.Path,
    hours: float,
    partition: str,
    num_gpus: int,
    num_cpus: int,
) -> None:
    """Queues one job for each run; what a site needs more, SBATCH_... variables say.

    Args:
      runs: at least one.
      logs: folder of what submitit writes; all nodes must see it.
      folder: that the commands are seen from.
      hours: time limit; the job is then queued again.
      partition: "" for the default one.
      num_gpus: of a job, 0 or 1.
      num_cpus: of a job.
    """
    import submitit

    minutes = max(round(hours * 60), 1)
    executor = submitit.SlurmExecutor(logs, max_num_timeout=_REQUEUES)
    executor.update_parameters(
        job_name="jaxil",
        time=minutes,
        cpus_per_task=num_cpus,
        # srun no longer takes it over from sbatch.
        srun_args=[f"--cpus-per-task={num_cpus}"],
        signal_delay_s=min(_SAVING_SECONDS, 15 * minutes),
        additional_parameters={"requeue": True},
        **({"partition": partition} if partition else {}),
        **({"gpus_per_node": num_gpus} if num_gpus else {}),
    )
    for first in range(0, len(runs), _ARRAY_SIZE):
        some = runs[first : first + _ARRAY_SIZE]
        workers = [
            Worker([run], Place(), folder=folder, patience_seconds=_PATIENCE_SECONDS)
            for run in some
        ]
        for run, job in zip(some, executor.submit_array(workers), strict=True):
            state.note_slurm_job(run, job.job_id)


def fault() -> str | None:
    """Returns why no job can be queued from here; None if one can."""
    if shutil.which("sbatch") is None:
        return "there is no command sbatch"
    try:
        subprocess.run(
            ["sinfo", "--noheader"],
            check=True,
            capture_output=True,
            text=True,
            timeout=_ANSWER_SECONDS,
        )
    except subprocess.CalledProcessError as error:
        said = error.stderr.strip().splitlines()
        return f"sinfo fails ({said[-1] if said else error.returncode})"
    except (subprocess.SubprocessError, OSError) as error:
        return f"sinfo fails ({error})"
    return None


def queued_jobs(runs: Sequence[Run]) -> frozenset[str]:
    """Returns which Slurm jobs of this user wait or run; none if no run has one."""
    has_jobs = any((run.folder / "slurm_job").exists() for run in runs)
    if not has_jobs or shutil.which("squeue") is None:
        return frozenset()
    arguments = ["squeue", "--noheader", "--array", "--format=%i"]
    arguments.append(f"--user={getpass.getuser()}")
    try:
        listed = subprocess.run(
            arguments,
            check=True,
            capture_output=True,
            text=True,
            timeout=_ANSWER_SECONDS,
        )
    except (subprocess.SubprocessError, OSError):
        return frozenset()  # without it a run may be queued twice, but not done twice
    return frozenset(listed.stdout.split())
