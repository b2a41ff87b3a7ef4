"""How long a call takes: repeated, its first time left out."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """Seconds that one call takes.

    Attributes:
      median: of all repeats; what is reported, since other processes only ever add.
      low: the shortest.
      high: the longest.
    """

    median: float
    low: float
    high: float


def timed(function: Callable[[], Any], repeats: int) -> Timing:
    """Calls a function once unmeasured, which may compile, then `repeats` times.

    Args:
      function: what it returns is waited for, since jax computes in the background.
      repeats: at least 1.
    """
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return Timing(float(np.median(seconds)), min(seconds), max(seconds))
