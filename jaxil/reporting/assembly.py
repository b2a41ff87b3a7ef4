"""The report: all figures and tables of some runs, and their page."""

import pathlib
from collections.abc import Sequence

from jaxil.reporting import charts, episodes, measures, page, paper, tables
from jaxil.reporting import folder as folders
from jaxil.reporting.groups import Group, make_groups, short, tasks_of
from jaxil.reporting.remarks import remarks
from jaxil.reporting.runs import Run
from jaxil.reporting.sheets import write


def write_report(
    runs: Sequence[Run],
    output: pathlib.Path,
    *,
    unreadable: list[str],
    num_seeds: int | None,
    num_videos: int,
    reload_seconds: int | None,
) -> None:
    """Writes index.html, figures/ and tables/ into a new folder.

    Args:
      runs: at least one.
      output: new folder; an older report there is replaced.
      unreadable: sentences about runs that cannot be read.
      num_seeds: how many seeds each variant should have; None if unknown.
      num_videos: how many videos of each variant to show.
      reload_seconds: how often browsers reload the page; None for never.

    Raises:
      OSError: it cannot be written.
    """
    groups = make_groups(runs)
    by_frames, frame_curves = charts.curve_sheet(groups, "frames", "learning_by_frames")
    by_hours, hour_curves = charts.curve_sheet(groups, "hours", "learning_by_hours")
    distance, distances = charts.curve_sheet(groups, "wasserstein", "wasserstein")
    finals = measures.finals(groups)
    soon = measures.early_by_task(groups)
    joined = measures.early_over_tasks(soon)
    filmed, left_out = episodes.collect(groups, num_videos)
    sheets = {
        "by_frames": by_frames,
        "by_hours": by_hours,
        "bars": charts.bar_sheet(groups, "final_returns"),
        "early": charts.early_sheet(soon, joined),
        "distance": distance,
        "logits": charts.logit_sheet(groups),
        "metrics": charts.metric_sheet(groups),
    }
    settings = tables.settings_table(groups)
    on_page = [
        tables.final_table(finals),
        tables.aggregate_table(finals),
        tables.efficiency_table(groups),
        tables.early_table(joined, len(soon)),
        tables.seed_table(groups, num_seeds),
        tables.run_table(groups),
    ]
    as_files = [
        tables.curve_table("learning_by_frames", frame_curves),
        tables.curve_table("learning_by_hours", hour_curves),
        tables.curve_table("wasserstein", distances),
    ]
    paper_figures = paper.paper_figures(groups, num_seeds)
    sentences = [*unreadable, *remarks(groups), *left_out]
    index = page.html(
        {
            "heading": "Imitation from pixels: " + _tasks(groups),
            "facts": _facts(groups, len(sentences)),
            "reload_seconds": reload_seconds,
            "shared": _shared(groups),
            "legend": {group.label: group.look for group in groups if group.measured},
            "settings": settings,
            **sheets,
            "paper": paper_figures,
            "episodes": filmed,
            "tables": on_page,
            "remarks": sentences,
        }
    )
    plotted = [*sheets.values(), *(episode.sheet for episode in filmed)]
    plotted += [figure.sheet for figure in paper_figures]
    with folders.replaced(output) as folder:
        for sheet in filter(None, plotted):
            write(sheet, folder / "figures")
        for table in (settings, *on_page, *as_files):
            if table.rows:
                path = folder / "tables" / f"{table.name}.csv"
                path.write_bytes(tables.to_csv(table))
        (folder / "index.html").write_bytes(index)


def _facts(groups: Sequence[Group], num_remarks: int) -> list[tuple[str, str]]:
    """Returns the numbers at the top of the page, with what they count."""
    runs = [run for group in groups for run in group.runs]
    frames = sum(run.frames for run in runs)
    return [
        (f"{len(runs)}", "runs"),
        (f"{sum(run.is_finished for run in runs)}", "finished"),
        (f"{len({run.task for run in runs})}", "tasks"),
        (f"{len({run.variant.method for run in runs})}", "methods"),
        (f"{len({run.seed for run in runs})}", "seeds"),
        (f"{frames / 1e6:.2f} M" if frames >= 1e5 else f"{frames:,.0f}", "frames"),
        (f"{sum(run.seconds for run in runs) / 3600:.1f}", "hours"),
        (f"{num_remarks}", "warnings"),
    ]


def _shared(groups: Sequence[Group]) -> str:
    shared = tables.shared_changes(groups)
    if not shared:
        return ""
    each = ", ".join(f"{field} {short(value)}" for field, value in shared.items())
    return f"All runs differ from the paper's settings in: {each}."


def _tasks(groups: Sequence[Group]) -> str:
    tasks = list(tasks_of(groups))
    return ", ".join(tasks) if len(tasks) <= 3 else f"{len(tasks)} tasks"
