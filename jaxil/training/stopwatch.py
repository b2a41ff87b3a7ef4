"""Measures what a run spends its time on."""

import contextlib
import time
from collections.abc import Iterator

from jaxil.environments.player import Environments


class Stopwatch:
    """Sums the seconds of a run by activity."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"environment": 0.0, "update": 0.0}
        self.reward_seconds = 0.0  # part of "update"

    @contextlib.contextmanager
    def timed(self, activity: str) -> Iterator[None]:
        """Adds the time of a block, or of each call of a function that it decorates."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[activity] += time.perf_counter() - start


class TimedEnvironments:
    """Environments whose calls, waiting included, count as "environment"."""

    def __init__(self, environments: Environments, stopwatch: Stopwatch) -> None:
        timed = stopwatch.timed("environment")
        self.size = environments.size
        self.reset = timed(environments.reset)
        self.step = timed(environments.step)
        self.receive = timed(environments.receive)
        self.close = environments.close
