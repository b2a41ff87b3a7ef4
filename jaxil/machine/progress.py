"""The one live line of whatever takes long: how far, how fast, how long still."""

import sys
import time
from collections.abc import Callable, Mapping
from typing import TextIO

_TTY_SECONDS = 0.2  # between two redraws in a terminal
_PLAIN_SECONDS = 30.0  # between two lines in a log file


class ProgressLine:
    """Writes one line on stderr: redrawn in a terminal, else a new one now and then.

    Frames per second and the split are those of the last half to whole window, so they
    follow a run that changes speed.
    """

    def __init__(
        self,
        total_frames: int,
        *,
        first_frame: int = 0,
        label: str = "",
        unit: str = "frames",
        stream: TextIO | None = None,
        window_seconds: float = 60.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Starts the clock.

        Args:
          total_frames: environment frames at the run's end, >= 1.
          first_frame: frame at which this process starts (not 0 after a resume).
          label: a few words for the line's beginning.
          unit: what is counted, if not environment frames.
          stream: where to write; stderr when None.
          window_seconds: longest time that speed and split are taken over.
          clock: seconds from any origin, for tests.
        """
        self._total_frames = total_frames
        self._label = f"{label}: " if label else ""
        self._unit = unit
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._clock = clock
        self._window_seconds = window_seconds
        now = clock()
        # Two marks half a window apart: speed is measured from the older one.
        self._marks = [(now, first_frame, {})] * 2
        self._next_write = now if self._live else now + _PLAIN_SECONDS / 10
        self._width = 0

    def update(
        self,
        frame: int,
        seconds: Mapping[str, float],
        returns: Mapping[str, float] | None = None,
        note: str = "",
    ) -> None:
        """Says where the run stands; cheap to call at every step.

        Args:
          frame: environment frames so far.
          seconds: total seconds so far by name, e.g. environment, update; what they
            leave of the wall clock is shown as the rest.
          returns: last returns by name, e.g. task, imitation, evaluation.
          note: a few words for the line's end.
        """
        now = self._clock()
        if now < self._next_write:
            return
        self._next_write = now + (_TTY_SECONDS if self._live else _PLAIN_SECONDS)
        line = self._line(now, frame, seconds, returns or {}, note)
        if now - self._marks[1][0] >= self._window_seconds / 2:
            self._marks = [self._marks[1], (now, frame, dict(seconds))]
        if self._live:
            self._stream.write("\r" + line.ljust(self._width))
            self._width = len(line)
        else:
            self._stream.write(line + "\n")
        self._stream.flush()

    def message(self, text: str) -> None:
        """Writes a lasting line of its own above the live one."""
        if self._live:
            self._stream.write("\r" + text.ljust(self._width) + "\n")
            self._width = 0
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Leaves the last live line standing."""
        if self._live and self._width:
            self._stream.write("\n")
            self._stream.flush()
            self._width = 0

    def _line(
        self,
        now: float,
        frame: int,
        seconds: Mapping[str, float],
        returns: Mapping[str, float],
        note: str,
    ) -> str:
        since, first_frame, before = self._marks[0]
        elapsed = max(now - since, 1e-9)
        speed = (frame - first_frame) / elapsed
        percent = 100 * frame / self._total_frames
        parts = [
            f"{self._label}{frame}/{self._total_frames} {self._unit} ({percent:.1f} %)",
            f"{speed:.{0 if speed >= 10 else 1}f} {self._unit}/s",
        ]
        if seconds:
            shares = {
                name: (total - before.get(name, 0.0)) / elapsed
                for name, total in seconds.items()
            }
            shares["rest"] = max(1.0 - sum(shares.values()), 0.0)
            parts.append(
                " ".join(f"{name} {100 * share:.0f}%" for name, share in shares.items())
            )
        if returns:
            shown = " ".join(f"{name} {value:.1f}" for name, value in returns.items())
            parts.append(f"return {shown}")
        left = self._total_frames - frame
        if speed > 0 and left > 0:
            parts.append(f"{duration(left / speed)} left")
        if note:
            parts.append(note)
        return " | ".join(parts)


def duration(seconds: float) -> str:
    """Writes a time span for people: 42 s, 12 min, 3 h 05 min, 2 d 04 h."""
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
