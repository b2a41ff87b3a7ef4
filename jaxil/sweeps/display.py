"""What a sweep shows: the plan and what it will take, the live table, the failures."""

import collections
import contextlib
import shlex
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from jaxil.machine.progress import duration
from jaxil.sweeps import state
from jaxil.sweeps.state import Run, State, Status

Statuses = Mapping[Run, Status]

_REFRESH_SECONDS = 3.0
_LOG_LINES = 8  # shown of a failed run
_PLAIN_WIDTH = 160  # of a table in a file or pipe, which has no width of its own
_NUMBERS = ("seed", "frame", "return", "frames/s", "left")
# Frames per second of one run at a time, where none has been measured. On the CPU, as
# the README's measurements; on a GPU, of fifteen at once on one H100 (2026-11-27).
GUESSES = {
    ("paper", "CPU"): 4.0,
    ("tiny", "CPU"): 40.0,
    ("paper", "GPU"): 220.0,
    ("tiny", "GPU"): 220.0,
}
_ENOUGH_SECONDS = 60.0  # until then a run has mostly compiled
_ENDS = (State.FINISHED, State.FAILED, State.DAMAGED)


def print_plan(statuses: Statuses) -> None:
    """Prints how many seeds of each task and variant are in which state."""
    cells: dict[tuple[str, str], list[Status]] = {}
    for run, status in statuses.items():
        cells.setdefault((run.task, run.slug), []).append(status)
    table = _table("task", "variant", "seeds")
    for (task, slug), seeds in sorted(cells.items()):
        table.add_row(task, slug, counts(seeds))
    _console().print(table)
    for run, status in statuses.items():
        if status.state is State.DAMAGED:
            of_table = "its table cannot be read and is set aside when it resumes"
            print(f"{run.name} is damaged: {state.damage(run) or of_table}")


def estimate(
    todo: Sequence[Run], statuses: Statuses, *, num_at_once: int, guess: float
) -> str:
    """Returns a sentence on what is left to do and how long it takes.

    Args:
      todo: the runs to be done.
      statuses: of all runs of the sweep, which show how fast it goes.
      num_at_once: runs that go on at a time.
      guess: frames per second of methods of which no run has shown its speed.
    """
    measured: dict[str, list[float]] = {}
    for run, status in statuses.items():
        speed = status.frames_per_second
        if speed is not None and status.seconds >= _ENOUGH_SECONDS:
            measured.setdefault(run.method, []).append(speed)
    frames = {run: max(run.total_frames - statuses[run].frame, 0) for run in todo}
    seconds = [
        left / statistics.median(measured.get(run.method, [guess]))
        for run, left in frames.items()
    ]
    # A run cannot be split, so it takes no less than the longest one.
    until_end = max(sum(seconds) / max(num_at_once, 1), *seconds)
    text = (
        f"Left to do: {sum(frames.values()):,} frames, {sum(seconds) / 3600:,.1f} hours"
        f" of runs; about {duration(until_end)} with {num_at_once} at a time"
    )
    guessed = {run.method: None for run in todo if run.method not in measured}
    if guessed:
        text += f" (a guess: {guess:g} frames/s for {', '.join(guessed)}, unmeasured)"
    return text


def print_failures(statuses: Statuses) -> None:
    """Prints each failed run with the end of its log."""
    for run, status in statuses.items():
        if status.state is State.FAILED:
            print(f"\n{run.name} failed (exit status {state.failure(run)}):")
            print(*(f"    {x}" for x in state.last_lines(run, _LOG_LINES)), sep="\n")
            print(f"\n  all of it: {run.folder / 'log.txt'}")
            print(f"  again, by hand: {shlex.join(run.command)}")


def counts(statuses: Iterable[Status]) -> str:
    """Returns how many runs are in which state, such as "3 finished, 1 failed"."""
    counter = collections.Counter(status.state for status in statuses)
    return ", ".join(f"{counter[s]} {s}" for s in State if counter[s])


def watch(look: Callable[[], Statuses]) -> Statuses:
    """Shows the runs that `look` returns until each has ended.

    Where the table cannot be redrawn, they are shown once.
    """
    console = _console()
    statuses = look()
    if not console.is_terminal:
        console.print(_live_table(statuses))
        return statuses
    with contextlib.suppress(KeyboardInterrupt), Live(console=console) as live:
        while True:
            live.update(_live_table(statuses))  # cut where the screen ends
            if all(status.state in _ENDS for status in statuses.values()):
                break
            time.sleep(_REFRESH_SECONDS)
            statuses = look()
    return statuses


def changes(before: dict[Run, State], statuses: Statuses) -> Iterator[str]:
    """Yields a line for each run whose state has changed; updates `before`."""
    for run, status in statuses.items():
        if before.get(run) is not status.state:
            before[run] = status.state
            result = status.last_return
            shown = "" if result is None else f", return {result:.1f}"
            yield f"{time.strftime('%H:%M:%S')} {run.name}: {status.state}{shown}"


def _live_table(statuses: Statuses) -> Table:
    order = list(State)
    rows = sorted(statuses.items(), key=lambda item: order.index(item[1].state))
    table = _table("task", "variant", "seed", "state", *_NUMBERS[1:])
    table.title = counts(statuses.values())
    for run, status in rows:
        speed = status.frames_per_second
        left = run.total_frames - status.frame
        is_open = status.state is not State.FINISHED and speed
        table.add_row(
            run.task,
            run.slug,
            str(run.seed),
            status.state,
            f"{status.frame:,}/{run.total_frames:,}",
            "" if status.last_return is None else f"{status.last_return:.1f}",
            f"{speed:.1f}" if speed else "",
            duration(left / speed) if is_open and speed else "",
        )
    return table


def _table(*columns: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, title_justify="left")
    for column in columns:
        justify = "right" if column in _NUMBERS else "left"
        table.add_column(column, justify=justify, no_wrap=True)
    return table


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
