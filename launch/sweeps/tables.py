"""What a sweep shows: the plan, the live table, the failures."""

import collections
import contextlib
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from jaxil.machine.progress import duration
from launch.sweeps import state
from launch.sweeps.plan import Run
from launch.sweeps.state import State, Status

Statuses = Mapping[Run, Status]

_REFRESH_SECONDS = 3.0
_LOG_LINES = 8  # shown of a failed run
_FRAME_LINES = 5  # of the table that are not runs
_PLAIN_WIDTH = 160  # of a table in a file or pipe, which has no width of its own


def print_plan(statuses: Statuses) -> None:
    """Prints how many seeds of each task and variant are in which state."""
    cells: dict[tuple[str, str], collections.Counter[State]] = {}
    for run, status in statuses.items():
        counter = cells.setdefault((run.task, run.slug), collections.Counter())
        counter[status.state] += 1
    table = _table("task", "variant", "seeds")
    for (task, slug), counter in sorted(cells.items()):
        table.add_row(task, slug, _counts(counter))
    _console().print(table)


def print_failures(statuses: Statuses) -> None:
    """Prints each failed run with the end of its log."""
    for run, status in statuses.items():
        if status.state is State.FAILED:
            print(f"\n{run.name} failed (exit status {state.failure(run)}):")
            print(
                "".join(f"    {line}\n" for line in state.last_lines(run, _LOG_LINES))
            )
            print(f"  all of it: {run.folder / 'log.txt'}")
            print(f"  again, by hand: {shlex.join(run.command)}")


def summary(statuses: Statuses) -> str:
    """Returns how many runs are in which state, such as "3 finished, 1 failed"."""
    return _counts(collections.Counter(s.state for s in statuses.values()))


def watch(look: Callable[[], Statuses]) -> Statuses:
    """Shows all runs until each has finished or failed; once where it can't redraw.

    Args:
      look: returns the runs as they are now.
    """
    console = _console()
    statuses = look()
    if not console.is_terminal:
        console.print(_live_table(statuses, len(statuses)))
        return statuses
    with contextlib.suppress(KeyboardInterrupt), Live(console=console) as live:
        while True:
            live.update(_live_table(statuses, console.height - _FRAME_LINES))
            if all(
                s.state in (State.FINISHED, State.FAILED) for s in statuses.values()
            ):
                break
            time.sleep(_REFRESH_SECONDS)
            statuses = look()
    return statuses


def changes(before: dict[Run, State], statuses: Statuses) -> Iterator[str]:
    """Yields a line for each run whose state is another one now; updates `before`."""
    for run, status in statuses.items():
        if before.get(run) is not status.state:
            before[run] = status.state
            if status.last_return is None:
                shown = ""
            else:
                shown = f", return {status.last_return:.1f}"
            yield f"{time.strftime('%H:%M:%S')} {run.name}: {status.state}{shown}"


def _live_table(statuses: Statuses, num_rows: int) -> Table:
    order = list(State)
    rows = sorted(statuses.items(), key=lambda item: order.index(item[1].state))
    table = _table(
        *("task", "variant", "seed", "state", "frame", "return", "frames/s", "left")
    )
    table.caption = summary(statuses)
    if len(rows) > num_rows:
        table.caption += f"; {len(rows) - num_rows} more than there is room for"
    for run, status in rows[: max(num_rows, 1)]:
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
    table = Table(box=box.SIMPLE_HEAD, caption_justify="left")
    for column in columns:
        is_number = column in ("seed", "frame", "return", "frames/s", "left")
        justify = "right" if is_number else "left"
        table.add_column(column, justify=justify, no_wrap=True)
    return table


def _counts(counter: collections.Counter[State]) -> str:
    return ", ".join(f"{counter[s]} {s}" for s in State if counter[s])


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
