"""A progress line: position, speed and time left."""

import contextlib
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TextIO

from jaxil.machine.screen import LastingStream

_TTY_SECONDS = 0.2  # between updates of a terminal's line, and of the speed
_PLAIN_SECONDS = 30.0  # between lines in a log file
_WINDOW_SECONDS = 60.0  # over which the speed is measured
_SETTLING_SECONDS = 25.0  # without a word on the time left
_SPARKS = "▁▂▃▄▅▆▇█"
_NUM_SPARKS = 16


class ProgressLine:
    """Shows a line on stderr: live in a terminal, else a new line every 30 s."""

    def __init__(
        self,
        total_frames: int,
        *,
        first_frame: int = 0,
        steady_from: int = 0,
        label: str = "",
        unit: str = "frames",
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Starts the clock.

        Args:
          total_frames: environment frames at the end, >= 1.
          first_frame: where this process starts; not 0 after a resume.
          steady_from: the time left is shown from some seconds after this frame on:
            before it nothing is learned, and right after it the learner is compiled.
          label: starts the line.
          unit: what is counted, if not environment frames.
          stream: None for stderr.
          clock: in seconds, for tests.
        """
        # Imported here, since `duration` does not need it.
        from rich import console, progress

        self._stream = LastingStream(stream)
        screen = console.Console(
            file=self._stream,  # pyright: ignore[reportArgumentType]
            force_terminal=self._stream.isatty(),
            highlight=False,
        )
        self._live = screen.is_terminal and not screen.is_dumb_terminal
        # rich also measures the speed if the line is not live.
        self._progress = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            console=screen,
            auto_refresh=False,
            redirect_stdout=False,
            redirect_stderr=False,
            speed_estimate_period=_WINDOW_SECONDS,
            get_time=clock,
        )
        self._newest: Mapping[str, float] = {}  # of the returns
        self._history: list[float] = []
        self._steady_from = steady_from
        self._is_steady = steady_from == 0
        self._steady_at = math.inf  # a time of the clock
        self._speed = 0.0  # the last one known
        self._label = f"{label}: " if label else ""
        self._unit = unit
        self._clock = clock
        self._began = clock()
        self._next_update = self._began
        self._next_line = self._began + _PLAIN_SECONDS / 10
        self._task = self._progress.add_task("", total=total_frames)
        # The first sample marks the start; rich ignores samples of 0.
        self._progress.update(self._task, completed=max(first_frame, 1e-9))

    def update(
        self,
        frame: int,
        seconds: Mapping[str, float],
        returns: Mapping[str, float] | None = None,
    ) -> None:
        """Shows the progress; cheap enough for every step.

        Args:
          frame: environment frames so far.
          seconds: spent so far by activity; what is missing is shown as "rest".
          returns: of the last episode, by name; a new mapping object for each episode.
            Those of the first name are also shown as a sparkline.
        """
        if returns and returns is not self._newest:
            self._newest = returns
            self._history += filter(math.isfinite, [*returns.values()][:1])
        now = self._clock()
        if now < self._next_update:
            return
        self._next_update = now + _TTY_SECONDS
        if not self._is_steady and frame >= self._steady_from:
            self._steady_at = min(self._steady_at, now + _SETTLING_SECONDS)
            if now >= self._steady_at:
                self._is_steady = True
                self._progress.reset(self._task)  # the speed too
        self._progress.update(self._task, completed=frame)
        if self._live:
            if not self._progress.live.is_started:
                self._progress.start()
                # A killed run would leave it hidden.
                self._progress.console.show_cursor(True)
            line = self._line(now, seconds, returns or {})
            self._progress.update(self._task, description=line, refresh=True)
        elif now >= self._next_line:
            self._next_line = now + _PLAIN_SECONDS
            self.message(self._line(now, seconds, returns or {}))

    def message(self, text: str) -> None:
        """Writes a permanent line, above the live one."""
        if self._live:
            self._progress.console.print(text, markup=False, soft_wrap=True)
        else:
            self._stream.write(f"{text}\n")

    def close(self) -> None:
        """Ends the live line."""
        self._progress.stop()

    def _line(
        self, now: float, seconds: Mapping[str, float], returns: Mapping[str, float]
    ) -> str:
        task = self._progress.tasks[0]
        self._speed = speed = task.speed or self._speed
        parts = [
            f"{self._label}{task.completed:.0f}/{task.total:.0f} {self._unit} "
            f"({task.percentage:.1f} %)",
            f"{speed:.{0 if speed >= 10 else 1}f} {self._unit}/s",
        ]
        if seconds:
            elapsed = max(now - self._began, 1e-9)
            shares = {name: total / elapsed for name, total in seconds.items()}
            shares["rest"] = max(1.0 - sum(shares.values()), 0.0)
            parts.append(" ".join(f"{k} {100 * v:.0f}%" for k, v in shares.items()))
        if returns:
            shown = " ".join(f"{name} {value:.1f}" for name, value in returns.items())
            parts.append(f"return {shown} {_sparkline(self._history)}".rstrip())
        if speed > 0 and self._is_steady and not task.finished:
            parts.append(f"{duration((task.remaining or 0.0) / speed)} left")
        return " | ".join(parts)


def _sparkline(values: Sequence[float]) -> str:
    """Returns a curve of at most 16 letters, each the mean of its share of values."""
    if not values:  # a task without rewards may return NaN
        return ""
    count = min(len(values), _NUM_SPARKS)
    ends = [len(values) * k // count for k in range(count + 1)]
    means = [statistics.fmean(values[a:b]) for a, b in itertools.pairwise(ends)]
    low, size = min(means), max(max(means) - min(means), 1e-9)
    top = len(_SPARKS) - 1
    return "".join(_SPARKS[round(top * (mean - low) / size)] for mean in means)


@contextlib.contextmanager
def shown(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yields a function (done, total) that shows a line on images in this block."""
    with contextlib.ExitStack() as stack:
        lines: list[ProgressLine] = []

        def show(done: int, total: int) -> None:
            if not lines:
                line = ProgressLine(total, first_frame=done, label=label, unit="images")
                lines.append(stack.enter_context(contextlib.closing(line)))
            lines[0].update(done, {})

        yield show


def duration(seconds: float) -> str:
    """Formats a duration: 42 s, 12 min, 3 h 05 min, 2 d 04 h."""
    seconds = max(seconds, 0.0)
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 24:
        return f"{hours} h {minutes:02d} min"
    days, hours = divmod(hours, 24)
    return f"{days} d {hours:02d} h"
