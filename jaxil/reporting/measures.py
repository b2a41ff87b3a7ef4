"""Metrics of a group: curves, last returns, and sample efficiency."""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxil.reporting import statistics
from jaxil.reporting.groups import Group
from jaxil.reporting.runs import Run, Table
from jaxil.reporting.statistics import Estimate

LEVELS = (0.5, 0.8, 0.9)  # of the expert's return
EARLY_FRAMES = 100_000  # where methods that learn from video alone are compared
_MAX_POINTS = 400  # of a curve; a figure's width shows no more


class Curve(NamedTuple):
    """The mean of a group's seeds over frames or hours.

    Attributes:
      group: whose.
      x: frames or hours, rising. Shape [X].
      mean: with Student's interval, NaN where one seed is left. Shapes [X].
      count: how many seeds have a value there. Shape [X].
      num_runs: how many seeds have any of it.
    """

    group: Group
    x: np.ndarray
    mean: Estimate
    count: np.ndarray
    num_runs: int


class Final(NamedTuple):
    """The last evaluations of a group.

    Attributes:
      group: whose.
      returns: of each measured run, in their order. Shape [S], S >= 1.
      mean: with Student's interval.
      expert: the mean return of the runs' own demonstrations; NaN without any.
      shares: each return as a share of that run's own expert's, NaN without. Shape [S].
    """

    group: Group
    returns: np.ndarray
    mean: Estimate
    expert: float
    shares: np.ndarray


class Early(NamedTuple):
    """How soon a group learns.

    Attributes:
      group: whose; joined over tasks, that of the first task.
      shares: `early_share` of each run that has one. Shape [S], S >= 1.
      iqm: their interquartile mean.
    """

    group: Group
    shares: np.ndarray
    iqm: Estimate


def curve(group: Group, x: str, y: str, *, table: str = "evaluation") -> Curve | None:
    """Joins the seeds of a group; None if none has such a column.

    Args:
      group: the seeds.
      x: "frame" or "hours".
      y: a column, such as "task_return_mean".
      table: "evaluation" or "training".
    """
    pieces = [series(getattr(run, table), x, y) for run in group.runs]
    found = [piece for piece in pieces if len(piece[0])]
    if not found:
        return None
    joined, values = statistics.join_curves(found)
    if len(joined) > _MAX_POINTS:
        shown = np.linspace(0, len(joined) - 1, _MAX_POINTS).round().astype(int)
        joined, values = joined[shown], values[:, shown]
    count = (~np.isnan(values)).sum(axis=0)
    return Curve(group, joined, statistics.mean_interval(values), count, len(found))


def series(table: Table, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns a column over frames or hours, x strictly rising; empty if not there."""
    column = "seconds" if x == "hours" else x
    if column not in table or y not in table:
        return np.zeros(0), np.zeros(0)
    good = np.isfinite(table[column]) & np.isfinite(table[y])
    position, first = np.unique(table[column][good], return_index=True)
    return position / 3600.0 if x == "hours" else position, table[y][good][first]


def final(group: Group) -> Final | None:
    """Returns the last evaluations; None before the first one."""
    if not group.measured:
        return None
    returns = np.array([run.returns[-1] for run in group.measured])
    experts = np.array([run.expert_return for run in group.measured])
    shares = returns / np.where(experts > 0, experts, np.nan)
    mean = statistics.mean_interval(returns)
    return Final(group, returns, mean, float(np.mean(experts)), shares)


def early(group: Group) -> Early | None:
    """Returns how soon a group learns; None if none of its runs is long enough."""
    shares = np.array([early_share(run) for run in group.measured])
    shares = shares[np.isfinite(shares)]
    if not len(shares):
        return None
    return Early(group, shares, statistics.interquartile_interval([shares]))


def early_by_task(groups: Sequence[Group]) -> dict[str, list[Early]]:
    """Returns how soon the groups learn, for tasks where one of them is long enough."""
    found: dict[str, list[Early]] = {}
    for each in filter(None, map(early, groups)):
        found.setdefault(each.group.task, []).append(each)
    return found


def early_over_tasks(tasks: Mapping[str, Sequence[Early]]) -> list[Early]:
    """Joins two or more tasks, for the variants that were run on all of them.

    The interval resamples seeds within each task.
    """
    if len(tasks) < 2:
        return []
    parts: dict[str, list[Early]] = {}
    for each in itertools.chain(*tasks.values()):
        parts.setdefault(each.group.label, []).append(each)
    found = []
    for same in parts.values():
        if len(same) == len(tasks):
            strata = [each.shares for each in same]
            iqm = statistics.interquartile_interval(strata)
            found.append(Early(same[0].group, np.concatenate(strata), iqm))
    return found


def arrivals(run: Run, x: str) -> list[float]:
    """Returns when a run first reached each of LEVELS of its expert; NaN for never.

    Args:
      run: any; a run reaches none without an expert of positive return, of which there
        would be no shares.
      x: "frame" or "hours".
    """
    position, returns = series(run.evaluation, x, "task_return_mean")
    expert = run.expert_return if run.expert_return > 0 else float("nan")
    levels = [share * expert for share in LEVELS]
    return [statistics.first_reaching(position, returns, level) for level in levels]


def early_share(run: Run) -> float:
    """Returns a run's mean share of the expert's return up to EARLY_FRAMES.

    NaN if it is shorter, or without an expert of positive return.
    """
    frames, returns = series(run.evaluation, "frame", "task_return_mean")
    if not run.expert_return > 0:
        return float("nan")
    return statistics.mean_until(frames, returns / run.expert_return, EARLY_FRAMES)
