"""The paper's figures: what is there, what is missing, and what makes it."""

from typing import NamedTuple

from jaxil.reporting import figures, results
from jaxil.reporting.groups import Group
from jaxil.reporting.results import Study
from jaxil.reporting.sheets import Sheet


class PaperFigure(NamedTuple):
    """One figure of the paper, as far as runs are there.

    Attributes:
      figure: which.
      sheet: what can be drawn; None without runs.
      counts: finished seeds, at most as many as wanted, by (task, variant's label).
      started: seeds that are there but not finished, by the same.
      command: makes what is missing; empty if nothing is.
    """

    figure: figures.Figure
    sheet: Sheet | None
    counts: dict[tuple[str, str], int]
    started: dict[tuple[str, str], int]
    command: str


def paper_figures(study: Study, num_seeds: int) -> list[PaperFigure]:
    """Returns all figures of the paper's experiments.

    Args:
      study: all runs; those with other settings than the paper's are drawn, too.
      num_seeds: how many each line should have, at least 1.
    """
    return [_figure(study, figure, num_seeds) for figure in figures.FIGURES.values()]


def _figure(study: Study, figure: figures.Figure, num_seeds: int) -> PaperFigure:
    slugs = [variant.slug for variant in figure.variants]
    groups = [
        group
        for group in study.groups
        if group.task in figures.TASKS and group.variant.slug in slugs
    ]
    counts: dict[tuple[str, str], int] = {}
    started: dict[tuple[str, str], int] = {}
    for task in figures.TASKS:
        for variant in figure.variants:
            own = [
                run
                for group in groups
                if group.task == task and group.variant.slug == variant.slug
                for run in group.runs
            ]
            finished = {run.seed for run in own if run.is_finished}
            key = (task, variant.label)
            counts[key] = min(len(finished), num_seeds)
            started[key] = len({run.seed for run in own} - finished)
    tasks = [
        task
        for task in figures.TASKS
        if any(counts[task, v.label] < num_seeds for v in figure.variants)
    ]
    command = (
        f"python launch/sweep.py --ablation=figure{figure.number} "
        f"--tasks={','.join(tasks)} --seeds={num_seeds} --workdir=DIR"
    )
    return PaperFigure(
        figure, _draw(study, figure, groups), counts, started, command if tasks else ""
    )


def _draw(study: Study, figure: figures.Figure, groups: list[Group]) -> Sheet | None:
    name = f"figure{figure.number:02d}"
    if figure.kind == "bars":
        return results.bar_sheet(study, results.finals(study, groups), name=name)
    over, column = {
        "frames": ("frame", "task_return_mean"),
        "hours": ("hours", "task_return_mean"),
        "wasserstein": ("frame", "wasserstein_to_expert"),
    }[figure.kind]
    sheet, _ = results.curve_sheet(study, groups, name=name, over=over, column=column)
    return sheet
