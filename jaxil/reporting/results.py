"""The figures and tables that any runs give: curves, last returns, efficiency."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxil.reporting import measures, plots, statistics
from jaxil.reporting.appearance import Look, looks
from jaxil.reporting.groups import Group, changes, expert_returns, tasks_of
from jaxil.reporting.measures import LEVELS, Curve, Final
from jaxil.reporting.runs import Run
from jaxil.reporting.sheets import Panel, Sheet
from jaxil.reporting.tables import Column, Kind, Table

_NAN = float("nan")
_LOGITS = ("discriminator/expert_logit", "discriminator/agent_logit")
_PERCENT = f"{statistics.CONFIDENCE:.0%}".replace("%", " %")


class Study(NamedTuple):
    """All runs of a report.

    Attributes:
      groups: in the order in which they are shown.
      looks: of their labels.
    """

    groups: tuple[Group, ...]
    looks: dict[str, Look]

    @property
    def runs(self) -> list[Run]:
        """All runs, group by group."""
        return [run for group in self.groups for run in group.runs]

    def expert(self, task: str) -> float:
        """Returns the return of a task's expert; NaN if none or several are known."""
        experts = expert_returns(g for g in self.groups if g.task == task)
        return experts[0][0] if len(experts) == 1 else _NAN


def make_study(groups: Sequence[Group]) -> Study:
    """Gives every group its look."""
    return Study(tuple(groups), looks(groups))


def curve_sheet(
    study: Study,
    groups: Sequence[Group],
    *,
    name: str,
    over: str,
    column: str = "task_return_mean",
) -> tuple[Sheet | None, list[Curve]]:
    """Draws one panel for each task, one line for each group.

    Args:
      study: where the groups are from.
      groups: those to show.
      name: of the files.
      over: "frame" or "hours".
      column: of eval.csv.

    Returns:
      None if no group has such a column; and the curves.
    """
    is_return = column == "task_return_mean"
    panels, found = [], []
    for task, some in tasks_of(groups).items():
        lines = [measures.curve(group, over, column) for group in some]
        shown = [line for line in lines if line is not None]
        found += shown
        if not shown:
            continue
        levels = [(1.0, "random policy")]
        if is_return:
            experts = expert_returns(g for g in study.groups if g.task == task)
            levels = [(value, f"expert {value:.0f}") for value, _ in experts]
        draw = functools.partial(
            plots.curves,
            lines=shown,
            looks=study.looks,
            levels=levels,
            over=over,
            name="task return" if is_return else "distance to the expert",
        )
        panels.append(Panel(task, draw))
    caption = (
        f"Mean over seeds; the band is its {_PERCENT} confidence interval (Student's "
        "t). A line without a band is a single seed; a line is faint where some of its "
        "seeds have no evaluation."
    )
    return _sheet(study, name, panels, [c.group for c in found], caption), found


def bar_sheet(study: Study, finals: Sequence[Final], *, name: str) -> Sheet | None:
    """Draws the last evaluations, one panel for each task."""
    tasks: dict[str, list[Final]] = {}
    for final in finals:
        tasks.setdefault(final.group.task, []).append(final)
    extent = max(map(plots.bars_extent, tasks.values()), default=0.0)
    panels = [
        Panel(
            task,
            functools.partial(
                plots.bars, finals=some, looks=study.looks, extent=extent
            ),
            plots.bars_height(extent),
            plots.BAR_MARGINS,
        )
        for task, some in tasks.items()
    ]
    caption = (
        "Mean over seeds of the last evaluation's mean return, with its "
        f"{_PERCENT} confidence interval (Student's t) and a dot for each seed. "
        "Hatched: some of these runs are unfinished."
    )
    return _sheet(study, name, panels, [], caption)


def logit_sheet(study: Study, *, name: str) -> Sheet | None:
    """Draws the discriminator's logits over frames."""
    panels, shown = [], []
    for task, groups in tasks_of(study.groups).items():
        pairs = []
        for group in groups:
            pair = [
                measures.curve(group, "frame", column, table="training")
                for column in _LOGITS
            ]
            if None not in pair:
                pairs.append(pair)
                shown.append(group)
        if pairs:
            draw = functools.partial(plots.logits, pairs=pairs, looks=study.looks)
            panels.append(Panel(task, draw))
    caption = (
        "The discriminator's mean logit of the expert's (solid) and the agent's "
        "(dotted) transitions, mean over seeds; label 1 is the expert."
    )
    # Dashes mean something else here, so the legend shows colours only.
    sheet = _sheet(study, name, panels, shown, caption)
    if sheet is None:
        return None
    legend = tuple((label, look._replace(dashes=())) for label, look in sheet.legend)
    return sheet._replace(legend=legend)


def finals(study: Study, groups: Sequence[Group]) -> list[Final]:
    """Returns the last evaluations of all groups that have one."""
    found = [measures.final(group, study.expert(group.task)) for group in groups]
    return [final for final in found if final is not None]


def curve_table(name: str, curves: Sequence[Curve], over: str) -> Table:
    """Returns the points of the curves."""
    keys = ("task", "variant", over, "seeds", "mean", "low", "high")
    rows = [
        (line.group.task, line.group.label, line.x[k], int(line.count[k]), *point)
        for line in curves
        for k, point in enumerate(zip(*line.mean, strict=True))
    ]
    return Table(name, tuple(Column(key, key) for key in keys), rows)


def final_table(finals: Sequence[Final]) -> Table:
    """Returns the last returns of each group."""
    columns = (
        Column("task", "task"),
        Column("variant", "variant"),
        Column("runs", "runs", "count"),
        Column("finished", "finished", "count"),
        *_interval_columns("mean", "mean", "return"),
        *_interval_columns("iqm", "IQM", "return"),
        Column("median", "median", "return"),
        Column("expert", "expert", "return"),
        Column("share_of_expert", "of the expert", "share"),
    )
    rows = [
        (
            f.group.task,
            f.group.label,
            len(f.returns),
            f.group.num_finished,
            *f.mean,
            *f.middle,
            np.median(f.returns),
            f.expert,
            f.mean.value / f.expert if f.expert > 0 else _NAN,
        )
        for f in finals
    ]
    return Table("final_returns", columns, rows)


def aggregate_table(finals: Sequence[Final]) -> Table | None:
    """Returns what a variant does over all its tasks, in shares of their experts.

    None unless a variant has runs on two tasks with known experts.
    """
    columns = (
        Column("variant", "variant"),
        Column("tasks", "tasks", "count"),
        Column("runs", "runs", "count"),
        *_interval_columns("iqm", "IQM", "share"),
        Column("median", "median", "share"),
        Column("mean", "mean", "share"),
    )
    labels: dict[str, list[np.ndarray]] = {}
    for f in finals:
        if f.expert > 0:
            labels.setdefault(f.group.label, []).append(f.returns / f.expert)
    rows = []
    for label, strata in labels.items():
        if len(strata) < 2:
            continue
        scores = np.concatenate(strata)
        middle = statistics.stratified_interval(strata)
        center = (np.median(scores), scores.mean())
        rows.append((label, len(strata), len(scores), *middle, *center))
    return Table("all_tasks", columns, rows) if rows else None


def efficiency_table(study: Study) -> Table:
    """Returns how soon each group was as good as shares of its expert."""
    columns = [
        Column("task", "task"),
        Column("variant", "variant"),
        Column("runs", "runs", "count"),
    ]
    for level in LEVELS:
        key, title = f"{level * 100:.0f}", f"{level:.0%}".replace("%", " %")
        columns += [
            Column(f"reached_{key}", f"reached {title}", "share"),
            Column(f"frames_{key}", "after frames", "count"),
            Column(f"hours_{key}", "after hours", "hours"),
        ]
    columns.append(Column("frames_per_second", "frames/s", "return"))
    rows = []
    for group in study.groups:
        if not group.measured:
            continue
        arrivals = [
            measures.arrival(run, study.expert(group.task)) for run in group.measured
        ]
        row: list[Any] = [group.task, group.label, len(arrivals)]
        has_expert = np.isfinite(
            [measures.expert_of(r, study.expert(r.task)) for r in group.measured]
        ).any()
        for place in range(len(LEVELS)):
            frames = np.array([arrival.frames[place] for arrival in arrivals])
            hours = np.array([arrival.hours[place] for arrival in arrivals])
            reached = float(np.isfinite(frames).mean()) if has_expert else _NAN
            row += [reached, *map(statistics.median_until, (frames, hours))]
        speeds = [run.frames_per_second for run in group.measured]
        rows.append((*row, float(np.median(speeds))))
    return Table("sample_efficiency", tuple(columns), rows)


def run_table(study: Study) -> Table:
    """Returns one row for each run."""
    columns = (
        Column("folder", "folder"),
        Column("task", "task"),
        Column("variant", "variant"),
        Column("seed", "seed", "count"),
        Column("state", "state"),
        Column("frames", "frames", "count"),
        Column("hours", "hours", "hours"),
        Column("frames_per_second", "frames/s", "return"),
        Column("last_return", "last return", "return"),
        Column("best_return", "best return", "return"),
        Column("expert_return", "expert", "return"),
        *(
            Column(f"frames_{level * 100:.0f}", f"{level * 100:.0f} % after", "count")
            for level in LEVELS
        ),
        Column("device", "device"),
        Column("settings", "settings unlike the paper's, not shared by all"),
        Column("remarks", "remarks"),
    )
    shared = shared_changes(study)
    rows = []
    for group in study.groups:
        for run in group.runs:
            arrival = measures.arrival(run, study.expert(run.task))
            rows.append(
                (
                    run.name,
                    run.task,
                    group.label,
                    run.seed,
                    run.state,
                    run.frames,
                    run.seconds / 3600,
                    run.frames_per_second,
                    run.returns[-1] if len(run.returns) else _NAN,
                    run.returns.max() if len(run.returns) else _NAN,
                    run.expert_return,
                    *arrival.frames,
                    run.device,
                    ", ".join(
                        f"{field}={value}"
                        for field, value in changes(run).items()
                        if field not in shared
                    ),
                    "; ".join(run.remarks),
                )
            )
    return Table("runs", columns, rows)


def shared_changes(study: Study) -> dict[str, Any]:
    """Returns the settings unlike the paper's that all runs have in common."""
    first, *others = [changes(run) for run in study.runs]
    return {
        field: value
        for field, value in first.items()
        if all(field in other and other[field] == value for other in others)
    }


def _interval_columns(key: str, title: str, kind: Kind) -> tuple[Column, ...]:
    """Returns the columns of a `statistics.Estimate`: a value and its bounds."""
    return (
        Column(key, title, kind),
        Column(f"{key}_low", f"{_PERCENT} from", kind),
        Column(f"{key}_high", "to", kind),
    )


def _sheet(
    study: Study,
    name: str,
    panels: Sequence[Panel],
    groups: Sequence[Group],
    caption: str,
) -> Sheet | None:
    if not panels:
        return None
    labels = {group.label for group in groups}
    legend = tuple((k, look) for k, look in study.looks.items() if k in labels)
    return Sheet(name, tuple(panels), legend, caption)
