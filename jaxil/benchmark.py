r"""Times and weighs every part of a run on this machine, and the loop that joins them.

    python -m jaxil.benchmark --config=configs/pdac_walker.py --json=benchmark.json
    python -m jaxil.benchmark --config=configs/pdac_walker.py --compare=benchmark.json
    python -m jaxil.benchmark --config=configs/pdac_walker.py \
        --sweep=batch_size:64,128,256 --json=batch_sizes.json

Medians over repeats, after a warm-up; nothing is learned and nothing kept. Compiling
without a cache, and starting a run, in a process of its own, are timed last; --nostart
leaves both out, as a sweep does. --full weighs memory with a full replay.
"""

import json
import os
import pathlib
import sys
from typing import Any

from absl import flags

from jaxil import command


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(argv, __doc__ or "", _define)
    environment = dict(os.environ)  # as a new process would find it
    from jaxil.machine import startup

    print(startup.prepare(), file=sys.stderr, flush=True)
    from jaxil.timing import comparison, measurement, sweeping, tables
    from jaxil.training import assembly

    faults = assembly.problems(values.config) + _flag_problems(values)
    if faults:
        raise command.UsageError(command.listing(faults))
    repeats, steps = values.repeats, values.steps
    if values.sweep is not None:
        sweep = sweeping.parse(values.sweep, values.config)
        found = []
        for value, config in sweep.configs.items():
            print(f"{sweep.field}={value}", file=sys.stderr, flush=True)
            results = measurement.measure(
                config, repeats=repeats, steps=steps, full=values.full
            )
            found.append({"sweep": {"field": sweep.field, "value": value}, **results})
        print(tables.machine_line(found[0]))
        print(tables.sweep_table(sweep.field, found))
        _write(values.json, found)
        return
    old = None if values.compare is None else comparison.read(values.compare)
    results = measurement.measure(
        values.config,
        repeats=repeats,
        steps=steps,
        environment=environment if values.start else None,
        full=values.full,
    )
    print(tables.results_table(results))
    if old is not None:
        print(f"\nagainst {values.compare}")
        print(tables.comparison_table(comparison.pairs(old, results)))
        for line in comparison.differences(old, results):
            print(f"warning: not the same: {line}", file=sys.stderr)
    _write(values.json, results)


def _flag_problems(values: flags.FlagValues) -> list[str]:
    """Returns one sentence for each flag that would fail only after minutes."""
    faults = []
    if values.sweep is not None and values.compare is not None:
        faults.append("--sweep and --compare don't go together; leave one out")
    if values.json is not None:
        path = pathlib.Path(values.json)
        if path.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
            faults.append(
                f"--json={values.json} can't be written; name a file in a folder of "
                "yours"
            )
    return faults


def _write(path: str | None, results: Any) -> None:
    if path is None:
        return
    from jaxil.files.writing import write_atomically

    try:
        write_atomically(path, (json.dumps(results, indent=2) + "\n").encode())
    except OSError as error:
        raise command.UsageError(
            f"--json={path} can't be written ({error.strerror}); name a file in a "
            "folder of yours"
        ) from error


def _define(values: flags.FlagValues) -> None:
    command.define_config(values)
    flags.DEFINE_string("json", None, "file for the results", flag_values=values)
    flags.DEFINE_string(
        "compare",
        None,
        "file of an earlier --json: prints old, new and their ratio",
        flag_values=values,
    )
    flags.DEFINE_string(
        "sweep",
        None,
        "FIELD:VALUE,VALUE,...: a config field to vary, such as batch_size:64,128; "
        "--json then gets a list",
        flag_values=values,
    )
    flags.DEFINE_boolean(
        "start",
        True,
        "time compiling without a cache and starting a run too",
        flag_values=values,
    )
    flags.DEFINE_boolean(
        "full",
        False,
        "fill the replay before memory is weighed, as in a run that is long under way",
        flag_values=values,
    )
    flags.DEFINE_integer(
        "repeats",
        10,
        "timings of each part",
        lower_bound=1,
        upper_bound=10_000,
        flag_values=values,
    )
    flags.DEFINE_integer(
        "steps",
        40,
        "decisions to time of the loop, with and without overlap",
        lower_bound=2,
        upper_bound=1_000_000,
        flag_values=values,
    )


if __name__ == "__main__":
    command.run(main)
