"""What a sweep will take, from what its runs have taken so far."""

import statistics
from collections.abc import Mapping

from jaxil.machine.progress import duration
from launch.sweeps.state import Run, Status

# Frames per second of one run at a time, where none has been measured. On the CPU, as
# the README's measurements; of GPUs no run is known yet.
_GUESSES = {
    ("paper", "CPU"): 4.0,
    ("tiny", "CPU"): 40.0,
    ("paper", "GPU"): 80.0,
    ("tiny", "GPU"): 150.0,
}
_ENOUGH_SECONDS = 60.0  # before that, a run has mostly compiled


def guessed_speed(preset: str, *, on_gpu: bool) -> float:
    """Returns a guess of the frames per second."""
    return _GUESSES[preset, "GPU" if on_gpu else "CPU"]


def estimate(
    todo: Mapping[Run, Status],
    statuses: Mapping[Run, Status],
    num_at_once: int,
    guess: float,
) -> str:
    """Returns a sentence on what is left.

    Args:
      todo: the runs to be done.
      statuses: of all runs of the sweep, which show how fast it goes.
      num_at_once: runs that go on at a time.
      guess: frames per second of a method that has not run here.
    """
    speeds = _speeds(statuses)
    frames = 0
    seconds = []
    guessed: dict[str, None] = {}
    for run, status in todo.items():
        speed = speeds.get((run.task, run.method), speeds.get((run.method,)))
        if speed is None:
            guessed[run.method] = None
        left = max(run.total_frames - status.frame, 0)
        frames += left
        seconds.append(left / (speed or guess))
    # The last runs cannot be shared out: no less than the longest one.
    until_end = max(sum(seconds) / max(num_at_once, 1), *seconds)
    text = (
        f"Left to do: {frames:,} frames, {sum(seconds) / 3600:,.1f} hours of runs; "
        f"about {duration(until_end)} with {num_at_once} at a time"
    )
    if guessed:
        text += f" (a guess: {guess:g} frames/s for {', '.join(guessed)}, unmeasured)"
    return text


def _speeds(statuses: Mapping[Run, Status]) -> dict[tuple[str, ...], float]:
    """Returns median frames per second by task and method, and by method."""
    speeds: dict[tuple[str, ...], list[float]] = {}
    for run, status in statuses.items():
        speed = status.frames_per_second
        if speed is not None and status.seconds >= _ENOUGH_SECONDS:
            for key in ((run.task, run.method), (run.method,)):
                speeds.setdefault(key, []).append(speed)
    return {key: statistics.median(values) for key, values in speeds.items()}
