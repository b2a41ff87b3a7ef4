"""Times repeated calls, after a first call that may compile."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """Seconds per call."""

    median: float  # not the mean: other processes only add time
    low: float
    high: float


def timed(function: Callable[[], Any], repeats: int) -> Timing:
    """Times a function until its result is ready, since jax is asynchronous."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return Timing(float(np.median(seconds)), min(seconds), max(seconds))
