"""Metrics of a group: curves, last returns, and sample efficiency."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
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
    """The mean of a group's seeds over frames or hours."""

    group: Group
    over: str  # "frame" or "hours"
    x: np.ndarray  # rising. Shape [X]
    mean: Estimate  # with Student's interval, NaN where one seed is left. Shapes [X]
    count: np.ndarray  # how many seeds have a value there. Shape [X]
    num_runs: int  # how many seeds have any of it


class Final(NamedTuple):
    """The last evaluations of a group."""

    group: Group
    returns: np.ndarray  # of each measured run, in their order. Shape [S], S >= 1
    mean: Estimate  # with Student's interval
    expert: float  # mean return of the runs' own demonstrations; NaN without any
    shares: np.ndarray  # of the return of each run's own expert, NaN without. Shape [S]


class Early(NamedTuple):
    """How soon a group learns."""

    group: Group  # joined over tasks, that of the first task
    shares: np.ndarray  # mean share of the expert's return, see `early`. Shape [S >= 1]
    iqm: Estimate  # the interquartile mean of the shares


def curves(
    groups: Iterable[Group], over: str, column: str, *, table: str = "evaluation"
) -> list[Curve]:
    """Joins the seeds of each group; leaves out groups that have no such column.

    `over` is "frame" or "hours"; `table`, "evaluation" or "training", has the column.
    """
    found = []
    for group in groups:
        pieces = [_series(getattr(run, table), over, column) for run in group.runs]
        pieces = [piece for piece in pieces if len(piece[0])]
        if not pieces:
            continue
        x, values = statistics.join_curves(pieces)
        if len(x) > _MAX_POINTS:
            shown = np.linspace(0, len(x) - 1, _MAX_POINTS).round().astype(int)
            x, values = x[shown], values[:, shown]
        count = (~np.isnan(values)).sum(axis=0)
        mean = statistics.mean_interval(values)
        found.append(Curve(group, over, x, mean, count, len(pieces)))
    return found


def finals(groups: Iterable[Group]) -> list[Final]:
    """Returns the last evaluations of those groups that have any."""
    found = []
    for group in groups:
        if not group.measured:
            continue
        returns = np.array([run.returns[-1] for run in group.measured])
        experts = np.array([run.expert_return for run in group.measured])
        shares = returns / np.where(experts > 0, experts, np.nan)
        mean = statistics.mean_interval(returns)
        found.append(Final(group, returns, mean, float(np.mean(experts)), shares))
    return found


def early(group: Group) -> Early | None:
    """Returns the mean shares of the expert's return up to EARLY_FRAMES.

    None if no run is long enough and has an expert of positive return.
    """
    shares = np.array([_early_share(run) for run in group.measured])
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


def arrivals(run: Run, over: str) -> list[float]:
    """Returns when a run first reached each of LEVELS of its expert; NaN for never.

    So without an expert of positive return. `over` is "frame" or "hours".
    """
    position, returns = _series(run.evaluation, over, "task_return_mean")
    expert = run.expert_return if run.expert_return > 0 else float("nan")
    levels = [share * expert for share in LEVELS]
    return [statistics.first_reaching(position, returns, level) for level in levels]


def _early_share(run: Run) -> float:
    if not run.expert_return > 0:
        return float("nan")
    frames, returns = _series(run.evaluation, "frame", "task_return_mean")
    return statistics.mean_until(frames, returns / run.expert_return, EARLY_FRAMES)


def _series(table: Table, over: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns x, strictly rising, and a column there; empty if it is missing."""
    x = "seconds" if over == "hours" else over
    if x not in table or column not in table:
        return np.zeros(0), np.zeros(0)
    good = np.isfinite(table[x]) & np.isfinite(table[column])
    position, first = np.unique(table[x][good], return_index=True)
    values = table[column][good][first]
    return position / 3600.0 if over == "hours" else position, values
