"""The paper's figures: what there is, what is missing, and the command for it."""

from typing import NamedTuple

from jaxil.reporting import charts, figures, measures
from jaxil.reporting.figures import Figure
from jaxil.reporting.groups import Group
from jaxil.reporting.sheets import Sheet


class PaperFigure(NamedTuple):
    """One figure of the paper, as far as there are runs for it.

    Attributes:
      figure: which.
      sheet: the plots; None where no runs show what it is about.
      num_finished: finished seeds of all tasks and variants, none beyond those wanted.
      num_wanted: how many there should be.
      command: trains what is missing; empty if nothing is.
    """

    figure: Figure
    sheet: Sheet | None
    num_finished: int
    num_wanted: int
    command: str


def paper_figures(groups: list[Group], num_seeds: int) -> list[PaperFigure]:
    """Returns all figures of the paper's experiments.

    Args:
      groups: of all runs; those with other settings than the paper's are plotted, too.
      num_seeds: how many each line should have, at least 1.
    """
    return [_figure(groups, each, num_seeds) for each in figures.FIGURES.values()]


def _figure(groups: list[Group], figure: Figure, num_seeds: int) -> PaperFigure:
    own = [
        group
        for group in groups
        if group.task in figures.TASKS and group.variant in figure.variants
    ]
    missing, num_finished = [], 0
    for task in figures.TASKS:
        counts = [_num_finished(own, task, v, num_seeds) for v in figure.variants]
        num_finished += sum(counts)
        if min(counts) < num_seeds:
            missing.append(task)
    command = (
        f"jaxil sweep --ablation=figure{figure.number} "
        f"--tasks={','.join(missing)} --seeds={num_seeds} --workdir=DIR"
    )
    # An ablation of which only the plain method has run shows nothing.
    shows = not figure.is_ablation or any(group.variant.overrides for group in own)
    return PaperFigure(
        figure,
        _sheet(figure, own) if shows else None,
        num_finished,
        len(figure.variants) * len(figures.TASKS) * num_seeds,
        command if missing else "",
    )


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
        finals = [f for f in map(measures.final, groups) if f is not None]
        return charts.bar_sheet(finals, name=name)
    over, column = {
        "frames": ("frame", "task_return_mean"),
        "hours": ("hours", "task_return_mean"),
        "wasserstein": ("frame", "wasserstein_to_expert"),
    }[figure.kind]
    return charts.curve_sheet(groups, name=name, over=over, column=column)[0]
