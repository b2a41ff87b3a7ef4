"""Measures what a run spends its time on."""

import time
from collections.abc import Callable
from typing import Any

from jaxil.environments.player import Environments


class Stopwatch:
    """Sums the seconds of a run by activity."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"environment": 0.0, "update": 0.0}
        self.reward_seconds = 0.0  # part of "update"

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Returns `function`, whose time is added to the activity `name`."""

        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[name] += time.perf_counter() - start

        return call


class TimedEnvironments:
    """Environments whose calls, waiting included, count as "environment"."""

    def __init__(self, environments: Environments, stopwatch: Stopwatch) -> None:
        self.size = environments.size
        self.reset = stopwatch.timed("environment", environments.reset)
        self.step = stopwatch.timed("environment", environments.step)
        self.receive = stopwatch.timed("environment", environments.receive)
        self.close = environments.close
