"""Statistics over seeds: means, intervals, and when a level is reached."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

_CONFIDENCE = 0.9  # of the paper's shaded areas
_NUM_RESAMPLES = 2000
_SEED = 0  # of the resampling, so that the same numbers give the same interval


class Estimate(NamedTuple):
    """A number, or an array of them, with its interval."""

    value: np.ndarray  # NaN without data
    low: np.ndarray  # the interval's ends; NaN where there is too little data for one
    high: np.ndarray


def mean_interval(values: np.ndarray) -> Estimate:
    """Returns the mean over S seeds, [S, ...] to [...], with Student's t interval.

    NaN is missing, and S may be 0. The interval needs two values, else it is NaN.
    """
    present = np.ma.masked_invalid(np.asarray(values, np.float64))
    count = present.count(axis=0)
    mean = np.ma.filled(present.mean(axis=0), np.nan)
    deviation = np.ma.filled(present.std(axis=0, ddof=1), np.nan)
    quantile = stats.t.ppf((1.0 + _CONFIDENCE) / 2.0, np.maximum(count - 1, 1))
    half = quantile * deviation / np.sqrt(np.maximum(count, 1))
    return Estimate(mean, mean - half, mean + half)


def interquartile_interval(strata: Sequence[np.ndarray]) -> Estimate:
    """Returns the interquartile mean of all values with its bootstrap interval.

    Seeds are resampled within each task, so that every resample has as many runs of
    each task as the data (Agarwal et al., 2021, "Deep Reinforcement Learning at the
    Edge of the Statistical Precipice"). The ends are percentiles.

    Args:
      strata: the values of each task, finite. Shapes [S_i], S_i >= 1.

    Returns:
      Three numbers; the interval is NaN where no task has two values.
    """
    several = [values for values in strata if len(values) > 1]
    single = np.array([values[0] for values in strata if len(values) == 1])

    def statistic(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
        fixed = np.broadcast_to(single, (*samples[0].shape[:-1], len(single)))
        return stats.trim_mean(np.concatenate([*samples, fixed], axis), 0.25, axis)

    value = stats.trim_mean(np.concatenate(strata), 0.25)
    if not several:
        return Estimate(value, np.asarray(np.nan), np.asarray(np.nan))
    interval = stats.bootstrap(
        several,
        statistic,
        n_resamples=_NUM_RESAMPLES,
        confidence_level=_CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(_SEED),
        vectorized=True,
    ).confidence_interval
    return Estimate(value, interval.low, interval.high)


def join_curves(
    curves: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolates curves that were measured at different x.

    Args:
      curves: (x, y) of each seed, x strictly rising. Shapes [X_i], X_i >= 1.

    Returns:
      All x that any seed has, rising, [X]; and each seed's y there, [S, X], linear
      between its own points and NaN beyond them: nothing is extrapolated.
    """
    x = np.unique(np.concatenate([x for x, _ in curves]))
    rows = [np.interp(x, own, y, left=np.nan, right=np.nan) for own, y in curves]
    return x, np.stack(rows)


def first_reaching(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """Returns the first x whose y is at `level` or above; NaN if none is."""
    there = np.flatnonzero(np.asarray(y) >= level)
    return float(x[there[0]]) if len(there) else float("nan")


def mean_until(x: np.ndarray, y: np.ndarray, end: float) -> float:
    """Returns the mean height of a curve from 0 to `end`: its area there over `end`.

    The curve is linear between its points, and from zero at x = 0 to the first one. The
    result is NaN if it ends before `end`.

    Args:
      x: positive, strictly rising. Shape [X].
      y: shape [X].
      end: positive.
    """
    if not len(x) or x[-1] < end:
        return float("nan")
    x, y = np.concatenate([[0.0], x]), np.concatenate([[0.0], y])
    inside = x < end
    heights = np.append(y[inside], np.interp(end, x, y))
    return float(np.trapezoid(heights, np.append(x[inside], end)) / end)


def median_arrival(times: Sequence[float]) -> float:
    """Returns the median time, where NaN, for never, counts as later than all.

    NaN where too few arrived for the median to exist.
    """
    if not len(times):
        return float("nan")
    # Of an even number, the later of the middle two: by then half have arrived.
    middle = np.sort(np.nan_to_num(times, nan=np.inf))[len(times) // 2]
    return float(middle) if np.isfinite(middle) else float("nan")
