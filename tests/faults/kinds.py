"""The kinds of faults: what is tried, and how often in full."""

import functools
import os
import pathlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

from jaxil.machine.child import ChildError, results
from tests.commands import ROOT
from tests.demonstrations import test_readers_fuzz as fuzz
from tests.faults import folders

_LIMITS: dict = {
    "seconds": 600.0,
    "cpu_seconds": 60,  # of one folder or file
    "memory_bytes": 4 * 1024**3,
    "result_bytes": 1024**2,
}


class Kind(NamedTuple):
    """One kind of fault.

    Attributes:
      about: for the table.
      full_count: how many the full campaign tries.
      run: (empty folder, count, seed) -> an outcome each, "" if it held.
    """

    about: str
    full_count: int
    run: Callable[[pathlib.Path, int, int], Iterator[str]]


def _damaged_folders(folder: pathlib.Path, count: int, seed: int) -> Iterator[str]:
    yield from _in_child(count, folders.outcomes, folder, count, seed)


def _hostile_files(folder: pathlib.Path, count: int, seed: int) -> Iterator[str]:
    """Shares the files out among the formats."""
    names = list(fuzz.FORMATS)
    for index, name in enumerate(names):
        share = (count + index) // len(names)
        (folder / name).mkdir()
        # The first of them is sound.
        work = (fuzz.read_mutants, name, folder / name, share + 1, 1 + seed * 10**6)
        for outcome in [*_in_child(share + 1, *work)][1:]:
            is_fine = outcome.startswith(("read ", "refused: "))
            yield "" if is_fine and outcome.isprintable() else f"{name}: {outcome}"


def _in_child(count: int, function: Callable, *arguments: object) -> Iterator[str]:
    """Yields what a function yields in a child of bounded time and memory."""
    done = 0
    try:
        for outcome in results(function, *arguments, **_LIMITS):
            done += 1
            yield outcome
    except ChildError as error:  # all that follow have not been tried either
        yield from [f"number {done}: {error}"] * (count - done)


def _runs(
    kind: str, methods: tuple[str, ...], folder: pathlib.Path, count: int, seed: int
) -> Iterator[str]:
    for index, method in enumerate(methods):
        share = (count + index) // len(methods)
        (folder / method).mkdir()
        words = [kind, method, str(share), str(seed), str(folder / method)]
        finished = subprocess.run(
            [sys.executable, "-m", "tests.faults.runs", *words],
            cwd=ROOT,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
        )
        outcomes = finished.stdout.splitlines()
        yield from outcomes
        missing = f"{' '.join(words[:3])} ended early: {finished.stderr[-300:]}"
        yield from [missing] * (share - len(outcomes))


_BOTH = ("pdac", "psil")
KINDS = {
    "killed": Kind(
        "killed at any moment, resumed: bit for bit",
        100,
        functools.partial(_runs, "killed", _BOTH),
    ),
    "stopped": Kind(
        "SIGTERM at any moment, resumed: bit for bit",
        50,
        functools.partial(_runs, "stopped", _BOTH),
    ),
    "out_of_disk": Kind(
        "disk full at any write, enlarged, resumed: bit for bit",
        20,
        functools.partial(_runs, "out_of_disk", _BOTH),
    ),
    "folders": Kind("run folders with a fault", 2000, _damaged_folders),
    "files": Kind("hostile demonstration files", 10_000, _hostile_files),
}
