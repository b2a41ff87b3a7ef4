r"""Turns folders of runs into one page with figures, tables and videos.

    jaxil report RUNS... --output=report

RUNS are folders; every folder with a config.json in or below them is a run, finished or
not. Writes report/index.html, which needs no network, report/figures (PNG and SVG) and
report/tables (CSV). Seeds are averaged with 90 % confidence intervals; runs with
different settings are kept apart. An older report there is replaced. --watch=SECONDS
rewrites it until Ctrl-C, and a browser that shows the page reloads it.
"""

import contextlib
import functools
import os
import pathlib
import sys
import time

from absl import flags

from jaxil import command
from jaxil.errors import UsageError

_MAX_SEEDS = 10_000


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(_named_runs(argv), __doc__ or "", _define, _problems)
    _write(values)
    with contextlib.suppress(KeyboardInterrupt):
        while values.watch:
            time.sleep(values.watch)
            _write(values)


def _roots(values: flags.FlagValues) -> list[pathlib.Path]:
    return [pathlib.Path(name) for name in dict.fromkeys(values.runs)]


def _problems(values: flags.FlagValues) -> list[str]:
    from jaxil.reporting import folder

    roots = _roots(values)
    missing = [root for root in roots if not os.path.isdir(root)]
    faults = [f"there is no folder {str(root)!r}" for root in missing]
    if not roots:
        faults.append("name the folders of runs: jaxil report RUNS...")
    if not values.output:
        return [*faults, "--output is empty: name a new folder"]
    return faults + folder.problems(pathlib.Path(values.output))


def _write(values: flags.FlagValues) -> None:
    """Reads the runs as they are now and writes their report."""
    from jaxil.reporting import assembly, runs

    roots, output = _roots(values), pathlib.Path(values.output)
    found, unreadable = [], []
    for place in runs.find(roots):
        try:
            found.append(runs.read(place))
        except runs.UnreadableError as error:
            unreadable.append(
                f"{runs.printable(place / 'config.json')} {error}; skipped"
            )
    if not found:
        names = ", ".join(map(str, roots))
        fault = (
            f"no run can be read in or below {names}: a run is a folder written by "
            "`jaxil train`, with a config.json"
        )
        raise UsageError([*unreadable, fault])
    for sentence in unreadable:
        print(sentence, file=sys.stderr)
    print(f"{len(found)} runs; plotting", file=sys.stderr, flush=True)
    try:
        assembly.write_report(
            found,
            output,
            unreadable=unreadable,
            num_seeds=values.seeds,
            num_videos=values.videos,
            reload_seconds=values.watch,
        )
    except OSError as error:
        raise UsageError(
            f"--output={str(output)!r} cannot be written ({error.strerror or error}); "
            "name a folder of yours on a disk with room"
        ) from error
    size = (output / "index.html").stat().st_size / 1e6
    index = runs.printable(output / "index.html")
    print(f"{index}: {len(found)} runs, {size:.1f} MB")


def _named_runs(argv: list[str]) -> list[str]:
    """Turns the words that are not flags into --runs=WORD, for the parser."""
    values = flags.FlagValues()
    _define(values)  # all take a value
    named, takes_value = argv[:1], False
    for word in argv[1:]:
        is_flag = word.startswith("-")
        named.append(word if is_flag or takes_value else f"--runs={word}")
        takes_value = is_flag and word.lstrip("-") in values
    return named


def _define(values: flags.FlagValues) -> None:
    about = "folder to look for runs in; the same as a word without a flag"
    flags.DEFINE_multi_string("runs", [], about, flag_values=values)
    about = "new folder; an older report there is replaced"
    flags.DEFINE_string("output", "report", about, flag_values=values)
    command.define_trust(values)
    define_number = functools.partial(flags.DEFINE_integer, flag_values=values)
    about = "how many seeds each variant should have; missing ones are listed"
    define_number("seeds", None, about, lower_bound=1, upper_bound=_MAX_SEEDS)
    about = "how many of the newest videos to show for each variant on each task"
    define_number("videos", 1, about, lower_bound=0)
    about = "seconds between rewrites of the report, which go on until Ctrl-C"
    define_number("watch", None, about, lower_bound=1, upper_bound=86_400)


if __name__ == "__main__":
    command.run(main)
