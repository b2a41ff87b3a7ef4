"""What is measured of a group: curves, last returns, and how soon it was good."""

from typing import NamedTuple

import numpy as np

from jaxil.reporting import statistics
from jaxil.reporting.groups import Group
from jaxil.reporting.runs import Run, Table
from jaxil.reporting.statistics import Estimate

LEVELS = (0.5, 0.8, 0.9)  # of the expert's return
# More than a figure's width can show.
_MAX_POINTS = 400


class Curve(NamedTuple):
    """The mean of a group's seeds over frames or hours.

    Attributes:
      group: whose.
      x: frames or hours, rising. Shape [X].
      mean: with Student's interval, NaN where one seed is left. Shapes [X].
      count: how many seeds have been there. Shape [X].
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
      middle: the interquartile mean, with its bootstrap interval.
      expert: the demonstrations' mean return; NaN if unknown.
    """

    group: Group
    returns: np.ndarray
    mean: Estimate
    middle: Estimate
    expert: float


class Arrival(NamedTuple):
    """When one run was first as good as a share of its expert.

    Attributes:
      run: which.
      frames: at the first evaluation at or above each of LEVELS; NaN for never.
      hours: the same in hours.
    """

    run: Run
    frames: tuple[float, ...]
    hours: tuple[float, ...]


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
    return Curve(
        group=group,
        x=joined,
        mean=statistics.mean_interval(values),
        count=(~np.isnan(values)).sum(axis=0),
        num_runs=len(found),
    )


def series(table: Table, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns a column over frames or hours, x strictly rising; empty if not there."""
    column = "seconds" if x == "hours" else x
    if column not in table or y not in table:
        return np.zeros(0), np.zeros(0)
    places, values = table[column], table[y]
    good = np.isfinite(places) & np.isfinite(values)
    places, first = np.unique(places[good], return_index=True)
    return places / 3600.0 if x == "hours" else places, values[good][first]


def final(group: Group, expert: float) -> Final | None:
    """Returns the last evaluations; None before the first one.

    Args:
      group: the seeds.
      expert: the return of the expert of runs that have none of their own.
    """
    if not group.measured:
        return None
    returns = np.array([run.returns[-1] for run in group.measured])
    experts = [expert_of(run, expert) for run in group.measured]
    return Final(
        group=group,
        returns=returns,
        mean=statistics.mean_interval(returns),
        middle=statistics.stratified_interval([returns]),
        expert=float(np.mean(experts)),
    )


def arrival(run: Run, expert: float) -> Arrival:
    """Says when a run reached each of LEVELS.

    Args:
      run: any.
      expert: the return of the expert, if the run has none of its own.
    """
    levels = [share * expert_of(run, expert) for share in LEVELS]

    def reached(x: str) -> tuple[float, ...]:
        places, returns = series(run.evaluation, x, "task_return_mean")
        return tuple(statistics.first_reaching(places, returns, at) for at in levels)

    return Arrival(run, reached("frame"), reached("hours"))


def expert_of(run: Run, other: float) -> float:
    """Returns the return of a run's expert, `other` if it imitates none."""
    return run.expert_return if np.isfinite(run.expert_return) else other
