"""What a sweep will take, from what its runs have taken so far."""

import statistics
from collections.abc import Mapping
from typing import NamedTuple

from jaxil.machine.progress import duration
from launch.sweeps.plan import Run
from launch.sweeps.state import Status

# Frames per second of one run at a time, where none has been measured. On the CPU, as
# the README's measurements; of GPUs no run is known yet.
_GUESSES = {
    ("paper", "CPU"): 4.0,
    ("tiny", "CPU"): 40.0,
    ("paper", "GPU"): 80.0,
    ("tiny", "GPU"): 150.0,
}
_ENOUGH_SECONDS = 60.0  # before that, a run has mostly compiled


class Cost(NamedTuple):
    """What is left to do.

    Attributes:
      frames: environment frames of all runs together.
      seconds: of all runs, one after the other.
      longest_seconds: of the longest run.
      guessed_methods: those whose speed nothing here has shown yet.
    """

    frames: int
    seconds: float
    longest_seconds: float
    guessed_methods: tuple[str, ...]


def estimate(
    todo: Mapping[Run, Status], statuses: Mapping[Run, Status], guess: float
) -> Cost:
    """Estimates what is left.

    Args:
      todo: the runs to be done.
      statuses: of all runs of the sweep, which show how fast it goes.
      guess: frames per second of a method that has not run here.
    """
    by_task, by_method = _speeds(statuses)
    frames, seconds, longest = 0, 0.0, 0.0
    guessed: dict[str, None] = {}
    for run, status in todo.items():
        left = max(run.total_frames - status.frame, 0)
        speed = by_task.get((run.task, run.method), by_method.get(run.method))
        if speed is None:
            guessed[run.method] = None
            speed = guess
        frames += left
        seconds += left / speed
        longest = max(longest, left / speed)
    return Cost(frames, seconds, longest, tuple(guessed))


def guessed_speed(preset: str, *, on_gpu: bool) -> float:
    """Returns frames per second as a guess."""
    return _GUESSES[preset, "GPU" if on_gpu else "CPU"]


def sentence(cost: Cost, num_at_once: int, guess: float) -> str:
    """Says for people what a sweep will take."""
    # The last runs can't be shared out: no less than the longest one.
    seconds = max(cost.seconds / max(num_at_once, 1), cost.longest_seconds)
    hours = cost.seconds / 3600
    text = (
        f"Left to do: {cost.frames:,} frames, {hours:,.1f} hours of runs; about "
        f"{duration(seconds)} with {num_at_once} at a time"
    )
    if cost.guessed_methods:
        text += (
            f" (a guess: {guess:g} frames/s for {', '.join(cost.guessed_methods)}, of "
            "which no run here has shown its speed yet)"
        )
    return text


def _speeds(
    statuses: Mapping[Run, Status],
) -> tuple[dict[tuple[str, str], float], dict[str, float]]:
    """Returns median frames per second by task and method, and by method."""
    by_task: dict[tuple[str, str], list[float]] = {}
    by_method: dict[str, list[float]] = {}
    for run, status in statuses.items():
        speed = status.frames_per_second
        if speed is not None and status.seconds >= _ENOUGH_SECONDS:
            by_task.setdefault((run.task, run.method), []).append(speed)
            by_method.setdefault(run.method, []).append(speed)
    return (
        {key: statistics.median(speeds) for key, speeds in by_task.items()},
        {key: statistics.median(speeds) for key, speeds in by_method.items()},
    )
