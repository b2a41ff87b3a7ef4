"""How long a call takes: repeated, after a first call that may compile."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """Seconds of one call over all repeats."""

    median: float  # what is reported: other processes only ever add time
    low: float
    high: float


def timed(function: Callable[[], Any], repeats: int) -> Timing:
    """Times a function, and waits for its result: jax computes asynchronously."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return Timing(float(np.median(seconds)), min(seconds), max(seconds))
