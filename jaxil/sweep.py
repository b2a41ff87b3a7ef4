r"""Trains many runs: tasks x variants x seeds, on this machine or a Slurm cluster.

    jaxil sweep --methods=pdac,psil --tasks=walker_walk --workdir=runs/main
    jaxil sweep --ablation=figure7 --seeds=5 --workdir=runs/main \
        --cluster=slurm --partition=gpu
    jaxil sweep --methods=drqv2 --preset=tiny --workdir=runs/tiny --watch

Each run is an ordinary `python -m jaxil.launch` in DIR/TASK/VARIANT/seedN. Rerun the
same command to complete missing, interrupted and failed runs; finished ones are not
repeated. --config.FIELD=VALUE changes a field in all runs that have it. Ctrl-C saves
and stops the runs on this machine. Exit status 1: a run has failed, is damaged or, if
this command was to finish it, is unfinished.
"""

import os
import pathlib
import shlex
import signal
import sys
from collections.abc import Sequence
from typing import Any

from absl import flags

from jaxil import command
from jaxil.errors import Fault, UsageError, collecting
from jaxil.machine import startup
from jaxil.reporting import figures
from jaxil.sweeps import clusters, display, plan, state
from jaxil.sweeps.state import Run, State, Status
from jaxil.training import workdir

Statuses = dict[Run, Status]

# What Slurm has in its queue, and what another process trains, needs no new job.
_AWAY = (State.FINISHED, State.QUEUED, State.RUNNING)


def main(argv: list[str]) -> int:
    """Runs the command; returns its exit status."""
    words = command.joined(argv[1:])
    overrides = [word for word in words if word.lstrip("-").startswith("config.")]
    rest = [word for word in words if word not in overrides]
    runs: list[Run] = []

    def check(values: flags.FlagValues) -> list[Fault | str]:
        faults: list[Fault | str] = []
        with collecting(faults):
            runs.extend(_checked_runs(values, _cluster(values), overrides))
        return faults

    values = command.parse([argv[0], *rest], __doc__ or "", _define, check)
    cluster = _cluster(values)
    if values.watch:
        statuses = display.watch(lambda: _look(runs))
        display.print_failures(statuses)
        bad = (State.FAILED, State.DAMAGED)
        return int(any(status.state in bad for status in statuses.values()))
    statuses = _look(runs)
    todo = [
        run
        for run, status in statuses.items()
        if status.state not in _AWAY and not state.damage(run)
    ]
    display.print_plan(statuses)
    if todo:
        at_once = clusters.num_at_once(cluster, len(todo))
        guess = display.GUESSES[values.preset, "GPU" if cluster.uses_gpus else "CPU"]
        print(display.estimate(todo, statuses, num_at_once=at_once, guess=guess))
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
    return _stay(cluster, statuses, values.workdir)


def _cluster(values: flags.FlagValues) -> clusters.Cluster:
    return clusters.Cluster(
        name=values.cluster,
        num_workers=values.workers,
        hours=values.hours,
        partition=values.partition,
        num_gpus=values.gpus,
        num_cpus=values.cpus,
    )


def _stay(cluster: clusters.Cluster, statuses: Statuses, folder: str) -> int:
    """Does the runs on this machine and prints what happens to them."""
    # Those of another sweep too, which may leave them unfinished.
    todo = [run for run, s in statuses.items() if s.state is not State.FINISHED]
    known = {run: status.state for run, status in statuses.items()}

    def tell() -> None:
        left = [run for run in todo if known[run] is not State.FINISHED]
        for line in display.changes(known, {run: state.status(run) for run in left}):
            print(line, flush=True)

    was_interrupted = False
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if todo:
            clusters.start(cluster, todo, pathlib.Path(folder), tell)
    except KeyboardInterrupt:
        was_interrupted = True
    tell()
    statuses = _look(list(statuses))
    print(f"\n{display.counts(statuses.values())}")
    if was_interrupted:
        print("stopped; rerun the same command to resume", file=sys.stderr)
        return 130
    display.print_failures(statuses)
    return int(any(s.state is not State.FINISHED for s in statuses.values()))


def _look(runs: Sequence[Run]) -> Statuses:
    queued = clusters.queued_jobs(runs)
    return {run: state.status(run, queued) for run in runs}


def _checked_runs(
    values: flags.FlagValues, cluster: clusters.Cluster, overrides: list[str]
) -> list[Run]:
    starts = not (values.dry_run or values.watch)
    faults: list[Fault | str] = [*clusters.problems(cluster, starts=starts)]
    folder = None
    with collecting(faults):
        folder = workdir.from_flag(values.workdir)
    pairs = [
        word.lstrip("-").removeprefix("config.").partition("=") for word in overrides
    ]
    request = plan.Request(
        methods=values.methods,
        ablations=values.ablation,
        tasks=list(dict.fromkeys(values.tasks)),
        num_seeds=values.seeds,
        preset=values.preset,
        folder=folder,
        overrides={field: value for field, _, value in pairs},
    )
    # `prepare` sets variables for this process; runs may be on another machine.
    environment = dict(os.environ)
    startup.prepare()
    from jaxil.training import assembly

    runs = []
    try:
        with collecting(faults):
            runs = plan.make_runs(request, assembly.problems)
    finally:
        os.environ.clear()
        os.environ.update(environment)
    if faults:
        raise UsageError(faults)
    return runs


def _define(values: flags.FlagValues) -> None:
    def define(kind: Any, name: str, default: Any, about: str) -> None:
        kind(name, default, about, flag_values=values)

    text, number, yes = flags.DEFINE_string, flags.DEFINE_integer, flags.DEFINE_boolean
    studies = ", ".join(figures.studies())
    methods = "methods, or package.module:METHOD; comma separated"
    define(flags.DEFINE_list, "methods", [], methods)
    ablations = f"variants of {studies}; beside the runs of --methods"
    define(flags.DEFINE_list, "ablation", [], ablations)
    define(flags.DEFINE_list, "tasks", list(figures.TASKS), "tasks, comma separated")
    define(number, "seeds", 10, "number of seeds")
    define(text, "preset", "paper", "paper, or tiny for CPU cores")
    define(text, "workdir", None, "folder of all runs; made if missing")
    define(text, "cluster", "local", "local, slurm, or debug: one run, on all cores")
    define(yes, "dry_run", False, "only print the plan and the commands")
    define(yes, "watch", False, "only show progress; Ctrl-C does not stop the runs")
    define(number, "workers", None, "local: runs at a time; one per GPU, else per core")
    define(flags.DEFINE_float, "hours", 24.0, "slurm: time limit, then requeued")
    define(text, "partition", "", "slurm: partition")
    define(number, "gpus", 1, "slurm: GPUs of a run, 0 or 1")
    define(number, "cpus", 4, "slurm: CPU cores of a run")


if __name__ == "__main__":
    command.run(main)
