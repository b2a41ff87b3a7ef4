"""Figures with panels by task: learning curves, last returns, what methods log."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxil.reporting import figures, measures, plots
from jaxil.reporting.groups import Group, expert_returns, tasks_of
from jaxil.reporting.measures import Curve, Early
from jaxil.reporting.sheets import Panel, Sheet
from jaxil.reporting.statistics import Estimate

# Axis, column of eval.csv, and what it is, by the kind of a figure.
_CURVES = {
    "frames": ("frame", "task_return_mean", "task return"),
    "hours": ("hours", "task_return_mean", "task return"),
    "wasserstein": ("frame", "wasserstein_to_expert", "distance to the expert"),
}
_LOGITS = ("discriminator/expert_logit", "discriminator/agent_logit")
_MOST_METRICS = 24  # panels in one figure; more would take long and be too small


def curve_sheet(
    groups: Sequence[Group], kind: str, name: str
) -> tuple[Sheet | None, list[Curve]]:
    """Plots one line for each group; also returns the lines. None without any.

    `kind` is "frames", "hours" or "wasserstein", see `figures.Figure`.
    """
    over, column, label = _CURVES[kind]
    panels, found = [], []
    for task, task_groups in tasks_of(groups).items():
        lines = measures.curves(task_groups, over, column)
        if not lines:
            continue
        found += lines
        levels = [(v, f"expert {v:.0f}") for v, _ in expert_returns(task_groups)]
        if kind == "wasserstein":
            levels = [(1.0, "random policy")]
        draw = functools.partial(plots.curves, lines=lines, levels=levels, name=label)
        panels.append(Panel(task, draw))
    caption = (
        "Mean over seeds; the band is its 90 % confidence interval (Student's t). A "
        "line without a band is a single seed; a line is faint where some of its seeds "
        "have no evaluation."
    )
    return _sheet(name, panels, [line.group for line in found], caption), found


def bar_sheet(groups: Sequence[Group], name: str) -> Sheet | None:
    """Plots the last evaluations; None without any."""
    panels = []
    for task, task_groups in tasks_of(groups).items():
        finals = measures.finals(task_groups)
        if not finals:
            continue
        experts = {round(f.expert, 1) for f in finals if np.isfinite(f.expert)}
        name_of_axis = "task return" + (", expert dashed" if experts else "")
        rows = []
        for group, returns, mean, *_ in finals:
            is_hatched = group.num_finished < len(group.runs)
            rows.append(plots.Bar(group, returns, mean, is_hatched))
        panels.append(_bar_panel(task, rows, levels=sorted(experts), name=name_of_axis))
    caption = (
        "Mean over seeds of the last evaluation's mean return, its 90 % confidence "
        "interval (Student's t) and a dot for each seed. Hatched: some of these runs "
        "are unfinished."
    )
    return _sheet(name, panels, [], caption)


def early_sheet(
    tasks: Mapping[str, Sequence[Early]], joined: Sequence[Early]
) -> Sheet | None:
    """Plots how soon each group learns; None if no run is long enough.

    `tasks` are of `measures.early_by_task`; `joined`, of `measures.early_over_tasks`,
    is the first panel, unless it is empty.
    """
    found = dict(tasks)
    if joined:
        found = {f"{len(tasks)} tasks together": joined, **tasks}
    axis = "% of the expert's return, expert dashed"
    panels = []
    for title, shown in found.items():
        rows = []
        for each in shown:
            percent = Estimate(*(100.0 * end for end in each.iqm))
            rows.append(plots.Bar(each.group, 100.0 * each.shares, percent))
        panels.append(_bar_panel(title, rows, levels=[100.0], name=axis))
    caption = (
        "Mean share of the expert's return up to "
        f"{measures.EARLY_FRAMES:,} environment frames: interquartile mean over seeds, "
        "its 90 % bootstrap interval and a dot for each run. Shorter runs are left out."
    )
    return _sheet("sample_efficiency", panels, [], caption)


def logit_sheet(groups: Sequence[Group]) -> Sheet | None:
    """Plots the discriminators' logits over frames; None without any."""
    panels, shown = [], []
    for task, task_groups in tasks_of(groups).items():
        pairs = []
        for group in task_groups:
            expert, agent = (
                measures.curves([group], "frame", column, table="training")
                for column in _LOGITS
            )
            if expert and agent:
                pairs.append((expert[0], agent[0]))
                # Dashes mean something else here: the legend shows colours only.
                shown.append(group._replace(look=group.look._replace(dashes=())))
        if pairs:
            panels.append(Panel(task, functools.partial(plots.logits, pairs=pairs)))
    caption = (
        "The discriminator's mean logit of the expert's (solid) and the agent's "
        "(dotted) transitions, mean over seeds; label 1 is the expert."
    )
    return _sheet("logits", panels, shown, caption)


def metric_sheet(groups: Sequence[Group]) -> Sheet | None:
    """Plots what the methods log about themselves over frames; None without any."""
    panels, found = [], []
    for task, task_groups in tasks_of(groups).items():
        declared = (figures.declaration(g.variant.method) for g in task_groups)
        columns = dict.fromkeys(column for d in declared for column in d.metrics)
        for column in columns:
            if column in _LOGITS:
                continue  # they have a figure of their own
            lines = measures.curves(task_groups, "frame", column, table="training")
            if lines:
                found += [line.group for line in lines]
                draw = functools.partial(plots.curves, lines=lines, name=column)
                panels.append(Panel(f"{task}: {column}", draw))
    caption = "The methods' own columns of train.csv, mean over seeds and its interval."
    if len(panels) > _MOST_METRICS:
        caption += f" The first {_MOST_METRICS} of {len(panels)}."
    return _sheet("metrics", panels[:_MOST_METRICS], found, caption)


def _bar_panel(title: str, rows: Sequence[plots.Bar], **axis: Any) -> Panel:
    draw = functools.partial(plots.bars, rows=rows, **axis)
    return Panel(title, draw, plots.bars_height(len(rows)), plots.BAR_MARGINS)


def _sheet(
    name: str, panels: Sequence[Panel], groups: Sequence[Group], caption: str
) -> Sheet | None:
    if not panels:
        return None
    legend = {group.label: group.look for group in groups}
    return Sheet(name, tuple(panels), tuple(legend.items()), caption)
