"""What several seeds say together: means, intervals, and when a level is reached."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

CONFIDENCE = 0.9  # of the paper's shaded areas
_NUM_RESAMPLES = 2000
_SEED = 0  # of the resampling, so that the same numbers give the same interval


class Estimate(NamedTuple):
    """A number, or an array of them, with its interval.

    Attributes:
      value: the estimate; NaN without data.
      low, high: the interval's ends; NaN where there is too little data for one.
    """

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def mean_interval(values: np.ndarray, *, confidence: float = CONFIDENCE) -> Estimate:
    """Returns the mean over the first axis with Student's t interval.

    Args:
      values: one row for each seed; NaN is missing. Shape [S, ...], S >= 0.
      confidence: of the two-sided interval, in (0, 1).

    Returns:
      Arrays of shape [...]; the interval is NaN where fewer than two values are there.
    """
    values = np.asarray(values, np.float64)
    _check_confidence(confidence)
    present = ~np.isnan(values)
    count = present.sum(axis=0)
    total = np.where(present, values, 0.0).sum(axis=0)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    squares = (np.where(present, values - mean, 0.0) ** 2).sum(axis=0)
    freedom = np.maximum(count - 1, 1)
    error = np.sqrt(squares / freedom / np.maximum(count, 1))
    half = special.stdtrit(freedom, (1.0 + confidence) / 2.0) * error
    half = np.where(count > 1, half, np.nan)
    return Estimate(mean, mean - half, mean + half)


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Returns the mean of the middle half along the last axis.

    A quarter of the values, rounded down, is left out at either end.

    Args:
      values: finite numbers. Shape [..., N], N >= 1.
    """
    ordered = np.sort(np.asarray(values, np.float64), axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def stratified_interval(
    strata: Sequence[np.ndarray],
    statistic: Callable[[np.ndarray], np.ndarray] = interquartile_mean,
    *,
    confidence: float = CONFIDENCE,
    num_resamples: int = _NUM_RESAMPLES,
) -> Estimate:
    """Returns a statistic of all values with its stratified bootstrap interval.

    Seeds are drawn with replacement within each task, so that every resample has as
    many runs of each task as the data (Agarwal et al., 2021, "Deep Reinforcement
    Learning at the Edge of the Statistical Precipice"). The ends are percentiles.

    Args:
      strata: the values of each task, finite. Shapes [S_i], not all empty.
      statistic: maps [..., N] to [...].
      confidence: of the two-sided interval, in (0, 1).
      num_resamples: how often to draw, at least 1.

    Returns:
      Three numbers; the interval is NaN where no task has two values.
    """
    _check_confidence(confidence)
    strata = [np.asarray(values, np.float64) for values in strata if len(values)]
    if not strata:
        raise ValueError("strata = []: expected at least one value")
    value = statistic(np.concatenate(strata))
    if all(len(values) < 2 for values in strata):
        nan = np.asarray(np.nan)
        return Estimate(value, nan, nan)
    rng = np.random.default_rng(_SEED)
    drawn = [
        values[rng.integers(len(values), size=(num_resamples, len(values)))]
        for values in strata
    ]
    resampled = statistic(np.concatenate(drawn, axis=1))
    tail = (1.0 - confidence) / 2.0
    low, high = np.quantile(resampled, (tail, 1.0 - tail))
    return Estimate(value, low, high)


def join_curves(
    curves: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Puts curves that were measured at different places on common ones.

    Args:
      curves: (x, y) of each seed, x strictly rising. Shapes [X_i], X_i >= 1.

    Returns:
      All x that any seed has, rising, [X]; and each seed's y there, [S, X], linear
      between its own points and NaN outside of them: nothing is extrapolated.
    """
    x = np.unique(np.concatenate([np.asarray(x, np.float64) for x, _ in curves]))
    rows = [np.interp(x, own, y, left=np.nan, right=np.nan) for own, y in curves]
    return x, np.stack(rows)


def first_reaching(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """Returns the first x whose y is at `level` or above; NaN if none is.

    Args:
      x: frames or hours, rising. Shape [X].
      y: returns; NaN reaches nothing. Shape [X].
      level: such as 0.8 of the expert's return; NaN is never reached.
    """
    there = np.flatnonzero(np.asarray(y) >= level)
    return float(x[there[0]]) if len(there) else float("nan")


def median_until(times: np.ndarray) -> float:
    """Returns the median time, seeds that never arrived counting as later than all.

    Args:
      times: one for each seed, NaN for never. Shape [S].

    Returns:
      NaN where too few arrived for the median to exist.
    """
    times = np.asarray(times, np.float64)
    if not len(times):
        return float("nan")
    # Of an even number the later of the middle two: half of the seeds are there then.
    middle = np.sort(np.where(np.isnan(times), np.inf, times))[len(times) // 2]
    return float(middle) if np.isfinite(middle) else float("nan")


def _check_confidence(confidence: float) -> None:
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence = {confidence}: expected a number in (0, 1)")
