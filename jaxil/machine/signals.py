"""Stopping a run from outside, without losing what it has done."""

import signal
from collections.abc import Callable
from typing import Any

_NAMES = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGTERM: "SIGTERM",
    signal.SIGHUP: "SIGHUP",  # the terminal was closed
}


class StopOnSignals:
    """Turns the first signal into a request to stop, another into an end at once.

    Another SIGHUP is ignored: shell and kernel may each send one for one terminal. And
    under `nohup`, which ignores the signal, all are.
    """

    def __init__(self, ask: Callable[[str], bool]) -> None:
        """Takes what is told the signal's name, and returns whether it is the first."""
        self._ask = ask

    def __enter__(self) -> None:
        """Takes over the signals."""
        self._before = {
            number: signal.signal(number, self._handle)
            for number in _NAMES
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
        }

    def __exit__(self, *_: Any) -> None:
        """Gives them back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: Any) -> None:
        if not self._ask(_NAMES[signal.Signals(number)]) and number != signal.SIGHUP:
            raise KeyboardInterrupt
