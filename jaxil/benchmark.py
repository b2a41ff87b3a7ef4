r"""Measures time and memory of each part of a run on this machine.

    jaxil benchmark --config=pdac:walker_walk --json=benchmark.json
    jaxil benchmark --config=pdac:walker_walk --compare=benchmark.json
    jaxil benchmark --config=pdac:walker_walk \
        --sweep=batch_size:64,128,256 --json=batch_sizes.json

Times are medians over repeats, after a warm-up. The run is not kept. Compiling without
a cache and starting a run are timed last, unless --nostart or --sweep is given.
"""

import functools
import json
import os
import pathlib
import sys
from typing import Any

from absl import flags

from jaxil import command
from jaxil.errors import UsageError, unknown_name
from jaxil.files.settings import flat
from jaxil.files.writing import obstacle, write_atomically, wrong_name

_EXAMPLE = "such as --sweep=batch_size:64,128,256"


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(argv, __doc__ or "", _define, _flag_problems)
    environment = dict(os.environ)  # before `prepare` changes it
    from jaxil.machine import startup

    print(startup.prepare(), file=sys.stderr, flush=True)
    from jaxil.timing import measurement, summary
    from jaxil.training import assembly

    if faults := assembly.problems(values.config):
        raise UsageError(faults)
    settings: Any = {name: values[name].value for name in ("repeats", "steps", "full")}
    if values.sweep is not None:
        results: Any = []
        field, configs = _swept(values.sweep, values.config)
        for value, config in configs.items():
            print(f"{field}={value}", file=sys.stderr, flush=True)
            found = measurement.measure(config, **settings)
            results.append({"sweep": {"field": field, "value": value}, **found})
        print(summary.machine_line(results[0]))
        print(summary.sweep_table(results))
    else:
        old = None if values.compare is None else summary.read(values.compare)
        if values.start:
            settings["environment"] = environment
        results = measurement.measure(values.config, **settings)
        print(summary.results_table(results))
        if old is not None:
            print(f"\nagainst {values.compare}")
            print(summary.comparison_table(old, results))
            for line in summary.differences(old, results):
                print(f"warning: not the same: {line}", file=sys.stderr)
    if values.json is not None:
        try:
            text = json.dumps(results, indent=2) + "\n"
            write_atomically(values.json, text.encode())
        except OSError as error:
            raise UsageError(_unwritable(values.json)) from error


def _swept(text: str, config: Any) -> tuple[str, dict[int | float, Any]]:
    """Reads FIELD:VALUE,VALUE,...; returns the field, and checked configs by value."""
    from jaxil.training import assembly

    field, _, words = text.partition(":")
    fields = flat(config.to_dict())
    kinds = {n: type(v) for n, v in fields.items() if type(v) in (int, float)}
    if field not in kinds:
        fault = unknown_name("--sweep", field, tuple(kinds))
        raise UsageError(f"{fault} (a field that is a number, {_EXAMPLE})")
    kind = "a whole number" if kinds[field] is int else "a number"
    faults, configs = [], {}
    for word in words.split(","):
        try:
            value = kinds[field](word)
        except ValueError:
            faults.append(f"--sweep={text!r}: {word!r} is not {kind}; write {_EXAMPLE}")
            continue
        configs[value] = config.copy_and_resolve_references()
        configs[value].update_from_flattened_dict({field: value})
        faults += assembly.problems(configs[value])
    if faults:
        raise UsageError(dict.fromkeys(faults))
    return field, configs


def _flag_problems(values: flags.FlagValues) -> list[str]:
    """Returns faults that would otherwise show only after minutes."""
    faults = []
    if values.sweep is not None and values.compare is not None:
        faults.append("--sweep and --compare cannot be combined; leave one out")
    if values.json is not None:
        path = pathlib.Path(values.json)
        is_place = os.path.isdir(path.parent) and not os.path.isdir(path)
        if not is_place or wrong_name(path) or obstacle(path.parent):
            faults.append(_unwritable(values.json))
    return faults


def _unwritable(path: str) -> str:
    return f"--json={path} cannot be written; choose a file in a writable folder"


def _define(values: flags.FlagValues) -> None:
    define_text = functools.partial(
        flags.DEFINE_string, default=None, flag_values=values
    )
    define_switch = functools.partial(flags.DEFINE_boolean, flag_values=values)
    define_number = functools.partial(
        flags.DEFINE_integer, upper_bound=10**6, flag_values=values
    )
    command.define_config(values)
    define_text("json", help="file for the results")
    define_text(
        "compare", help="file of an earlier --json: prints old, new and their ratio"
    )
    field = "a config field to vary, such as batch_size:64,128"
    define_text(
        "sweep", help=f"FIELD:VALUE,VALUE,...: {field}; --json then writes a list"
    )
    define_switch(
        "start", True, "also time compiling without a cache and starting a run"
    )
    define_switch("full", False, "fill the replay before memory is measured")
    repeats = "timings of each part; ten times as many of the short ones"
    define_number("repeats", 10, repeats, lower_bound=1)
    steps = "agent steps to time of the loop, with and without overlap"
    define_number("steps", 40, steps, lower_bound=2)


if __name__ == "__main__":
    command.run(main)
