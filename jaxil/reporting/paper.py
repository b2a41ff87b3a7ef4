"""The paper's figures: those that these runs show, and the commands for the rest."""

from typing import NamedTuple

from jaxil.reporting import charts, figures
from jaxil.reporting.figures import Figure
from jaxil.reporting.groups import Group
from jaxil.reporting.sheets import Sheet


class PaperFigure(NamedTuple):
    """One figure of the paper, as far as there are runs for it."""

    figure: Figure
    sheet: Sheet | None  # None without two methods or variants to compare
    lacks: str  # what is missing; empty if nothing is
    command: str  # trains the missing runs


def paper_figures(groups: list[Group], num_seeds: int | None) -> list[PaperFigure]:
    """Returns all figures of the paper's experiments, also of runs with other settings.

    `num_seeds` is how many seeds each line should have; if that is not known (None), a
    figure lacks nothing once it can be plotted.
    """
    return [_figure(groups, each, num_seeds) for each in figures.FIGURES.values()]


def _figure(groups: list[Group], figure: Figure, num_seeds: int | None) -> PaperFigure:
    own = [
        group
        for group in groups
        if group.task in figures.TASKS and group.variant in figure.variants
    ]
    variants = [group.variant for group in own if group.measured]
    # Ablations, which have the short budget, need more than plain methods.
    is_shown = len({variant.label for variant in variants}) > 1 and (
        not figure.has_short_budget or any(variant.overrides for variant in variants)
    )
    sheet = _sheet(figure, own) if is_shown else None
    command = f"jaxil sweep --ablation=figure{figure.number}"
    if num_seeds is None:
        lacks = "" if sheet else "no runs to compare"
        return PaperFigure(figure, sheet, lacks, f"{command} --workdir=DIR")
    missing, num_finished = [], 0
    for task in figures.TASKS:
        counts = [_num_finished(own, task, v, num_seeds) for v in figure.variants]
        num_finished += sum(counts)
        if min(counts) < num_seeds:
            missing.append(task)
    num_wanted = len(figure.variants) * len(figures.TASKS) * num_seeds
    lacks = f"{num_finished} of {num_wanted} runs are finished" if missing else ""
    command += f" --tasks={','.join(missing)} --seeds={num_seeds} --workdir=DIR"
    return PaperFigure(figure, sheet, lacks, command)


def _num_finished(
    groups: list[Group], task: str, variant: figures.Variant, most: int
) -> int:
    """Returns how many seeds of a variant are finished on a task, at most `most`."""
    runs = [
        run
        for group in groups
        if (group.task, group.variant) == (task, variant)
        for run in group.runs
    ]
    return min(len({run.seed for run in runs if run.is_finished}), most)


def _sheet(figure: Figure, groups: list[Group]) -> Sheet | None:
    name = f"figure{figure.number:02d}"
    if figure.kind == "bars":
        return charts.bar_sheet(groups, name)
    return charts.curve_sheet(groups, figure.kind, name)[0]
