"""Signals that stop a run, which saves first."""

import signal
from collections.abc import Callable
from typing import Any

_NAMES = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGTERM: "SIGTERM",
    signal.SIGHUP: "SIGHUP",  # the terminal was closed
}


class StopOnSignals:
    """Makes the first signal a request to stop, and the second end the process.

    A second SIGHUP is ignored, since shell and kernel may each send one; under `nohup`
    the first is, too.
    """

    def __init__(self, ask: Callable[[str], bool]) -> None:
        """`ask`, called with the signal's name, returns whether this is the first."""
        self._ask = ask

    def __enter__(self) -> None:
        """Installs the handlers."""
        self._before = {
            number: signal.signal(number, self._handle)
            for number in _NAMES
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
        }

    def __exit__(self, *_: Any) -> None:
        """Restores the previous handlers."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: Any) -> None:
        if not self._ask(_NAMES[signal.Signals(number)]) and number != signal.SIGHUP:
            raise KeyboardInterrupt
