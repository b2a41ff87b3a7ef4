r"""Makes many runs: tasks x variants x seeds, on this machine or a Slurm cluster.

    python launch/sweep.py --methods=pdac,psil --tasks=walker_walk --workdir=runs/main
    python launch/sweep.py --ablation=figure7 --seeds=5 --workdir=runs/main \
        --cluster=slurm --partition=gpu
    python launch/sweep.py --methods=drqv2 --preset=tiny --workdir=runs/tiny --watch

Each run is an ordinary `python -m jaxil.launch` in DIR/TASK/VARIANT/seedN, and the
folders are all that a sweep remembers: the same command again does what is missing,
cut off or failed, and nothing twice. --config.FIELD=VALUE changes a field in all runs.
Ctrl-C stops all runs of this machine, saved. Exit status 1: some run has failed.
"""

import contextlib
import os
import pathlib
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from typing import Any

# The project's root in place of this folder, as for `python -m`.
sys.path[0] = str(pathlib.Path(__file__).resolve().parent.parent)

from absl import flags  # noqa: E402

from jaxil import command  # noqa: E402
from jaxil.errors import UsageError  # noqa: E402
from jaxil.machine import startup  # noqa: E402
from jaxil.reporting import figures  # noqa: E402
from launch.sweeps import clusters, cost, faults, plan, slurm, state, tables  # noqa: E402
from launch.sweeps.state import State, Status  # noqa: E402


def main(argv: list[str]) -> int:
    """Runs the command; returns its exit status."""
    overrides = [word for word in argv if word.startswith("--config.")]
    rest = [word for word in argv if word not in overrides]
    values = command.parse(rest, __doc__ or "", _define)
    cluster = clusters.Cluster(
        name=values.cluster,
        num_workers=values.workers,
        hours=values.hours,
        partition=values.partition,
        num_gpus=values.gpus,
        num_cpus=values.cpus,
    )
    runs = _checked_runs(values, cluster, overrides)
    if values.watch:
        return _status_of(tables.watch(lambda: _look(runs)))
    statuses = _look(runs)
    # What Slurm has in its queue, and what someone does already, needs no other job.
    away = (State.FINISHED, State.QUEUED, State.RUNNING)
    todo = [run for run in runs if statuses[run].state not in away]
    tables.print_plan(statuses)
    guess = cost.guessed_speed(values.preset, on_gpu=clusters.uses_gpus(cluster))
    if todo:
        left = cost.estimate({run: statuses[run] for run in todo}, statuses, guess)
        print(cost.sentence(left, clusters.num_at_once(cluster, len(todo)), guess))
    else:
        print("Nothing is left to start.")
    if values.dry_run:
        print(*(shlex.join(run.command) for run in todo), sep="\n")
        return 0
    if todo:
        print(f"Each run is a command such as\n  {shlex.join(todo[0].command)}")
    if cluster.name == "slurm":
        if todo:
            clusters.start(cluster, todo, pathlib.Path(values.workdir), lambda: None)
        print(f"{len(todo)} submitted; see them with the same command and --watch")
        return 0
    return _stay(cluster, runs, statuses, values.workdir)


def _stay(
    cluster: clusters.Cluster,
    runs: Sequence[plan.Run],
    statuses: dict[plan.Run, Status],
    folder: str,
) -> int:
    """Has the runs done here, telling what happens to them."""
    # Runs that another sweep has may be left unfinished by it.
    todo = [run for run in runs if statuses[run].state is not State.FINISHED]
    known = {run: status.state for run, status in statuses.items()}

    def tell() -> None:
        open_runs = [run for run in todo if known[run] is not State.FINISHED]
        for line in tables.changes(
            known, {run: state.status(run) for run in open_runs}
        ):
            print(line, flush=True)

    interrupted = False
    try:
        with _ended_like_ctrl_c():
            if todo:
                clusters.start(cluster, todo, pathlib.Path(folder), tell)
    except KeyboardInterrupt:
        interrupted = True
    tell()
    statuses = _look(runs)
    print(f"\n{tables.summary(statuses)}")
    if interrupted:
        print("stopped; the same command goes on", file=sys.stderr)
        return 130
    tables.print_failures(statuses)
    unfinished = [s for s in statuses.values() if s.state is not State.FINISHED]
    if unfinished and not any(s.state is State.FAILED for s in unfinished):
        print(f"not all is finished: what workers said is in {folder}/.sweep")
    return 1 if unfinished else 0


def _status_of(statuses: Any) -> int:
    tables.print_failures(statuses)
    return int(any(s.state is State.FAILED for s in statuses.values()))


def _look(runs: Sequence[plan.Run]) -> dict[plan.Run, Status]:
    queued = slurm.queued_jobs(runs)
    return {run: state.status(run, queued) for run in runs}


def _checked_runs(
    values: flags.FlagValues, cluster: clusters.Cluster, overrides: list[str]
) -> list[plan.Run]:
    starts = not (values.dry_run or values.watch)
    sentences = list(clusters.problems(cluster, starts=starts))
    if values.workdir is None:
        sentences.append("--workdir is missing: name a folder for all runs")
    request = plan.Request(
        methods=values.methods,
        ablations=values.ablation,
        tasks=list(dict.fromkeys(values.tasks)),
        num_seeds=values.seeds,
        preset=values.preset,
        folder=pathlib.Path(values.workdir or "."),
        overrides=overrides,
    )
    runs = []
    with _checking_environment():
        from jaxil.training import assembly

        try:
            runs = plan.make_runs(request, assembly.problems)
        except faults.Faulty as error:
            sentences += error.sentences
    if sentences:
        raise UsageError(sentences)
    return runs


@contextlib.contextmanager
def _checking_environment() -> Iterator[None]:
    """Prepares this process for jax, and takes back what that has set.

    A run finds out for itself: it may be made on another machine.
    """
    before = dict(os.environ)
    startup.prepare()
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextlib.contextmanager
def _ended_like_ctrl_c() -> Iterator[None]:
    """Makes SIGTERM stop the sweep as Ctrl-C does."""

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _define(values: flags.FlagValues) -> None:
    def define(kind: Any, name: str, default: Any, about: str) -> None:
        kind(name, default, about, flag_values=values)

    text, number, yes = flags.DEFINE_string, flags.DEFINE_integer, flags.DEFINE_boolean
    figure_names = ", ".join(f"figure{n}" for n in figures.FIGURES)
    define(flags.DEFINE_list, "methods", [], "methods, comma separated")
    define(flags.DEFINE_list, "ablation", [], f"variants of {figure_names}")
    define(flags.DEFINE_list, "tasks", list(figures.TASKS), "tasks, comma separated")
    define(number, "seeds", 10, "number of seeds")
    define(text, "preset", "paper", "paper, or tiny for CPU cores")
    define(text, "workdir", None, "folder of all runs; made if missing")
    define(text, "cluster", "local", "local, slurm, or debug: in this process")
    define(yes, "dry_run", False, "only print the plan and the commands")
    define(yes, "watch", False, "only show how far the runs are; Ctrl-C leaves them be")
    define(number, "workers", None, "local: runs at a time; one per GPU, else per core")
    define(flags.DEFINE_float, "hours", 24.0, "slurm: limit; then it is queued again")
    define(text, "partition", "", "slurm: partition")
    define(number, "gpus", 1, "slurm: GPUs of a run, 0 or 1")
    define(number, "cpus", 4, "slurm: CPU cores of a run")


if __name__ == "__main__":
    command.run(main)
