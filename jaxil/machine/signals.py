"""Stopping a run from outside, without losing what it has done."""

import signal
from collections.abc import Callable
from typing import Any


class StopOnSignals:
    """Turns the first Ctrl-C or SIGTERM into a request, the second into an end."""

    def __init__(self, ask: Callable[[str], bool]) -> None:
        """Prepares.

        Args:
          ask: told the signal's name; returns whether it is the first request.
        """
        self._ask = ask

    def __enter__(self) -> None:
        """Takes over SIGINT (Ctrl-C) and SIGTERM."""
        self._before = {
            number: signal.signal(number, self._handle)
            for number in (signal.SIGINT, signal.SIGTERM)
        }

    def __exit__(self, *_: Any) -> None:
        """Gives both back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: Any) -> None:
        del frame
        if not self._ask("Ctrl-C" if number == signal.SIGINT else "SIGTERM"):
            raise KeyboardInterrupt
