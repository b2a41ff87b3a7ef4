"""The report from top to bottom: sections, in the order in which they are read."""

import pathlib
from collections.abc import Sequence

from jaxil.reporting import episodes, groups, paper, results, summary
from jaxil.reporting import folder as folders
from jaxil.reporting.page import Page
from jaxil.reporting.runs import Run
from jaxil.reporting.sheets import Sheet, write
from jaxil.reporting.tables import Table, to_csv


def write_report(
    runs: Sequence[Run],
    output: pathlib.Path,
    *,
    unreadable: list[str],
    num_seeds: int,
    num_videos: int,
) -> None:
    """Writes index.html, figures/ and tables/ into a new folder.

    Args:
      runs: at least one.
      output: where; an older report there is replaced as a whole.
      unreadable: sentences about folders that hold no run that can be read.
      num_seeds: how many seeds each variant should have, at least 1.
      num_videos: how many of each variant to show, at least 0.

    Raises:
      OSError: if it can't be written.
    """
    study = results.make_study(groups.make_groups(runs))
    page = Page("Imitation from pixels: " + _tasks(study))
    tables: list[Table] = []
    drawn: list[Sheet] = []

    def show(sheet: Sheet | None, missing: str) -> None:
        page.sheet(sheet, missing)
        drawn.extend([sheet] if sheet else [])

    def tabulate(table: Table) -> None:
        page.table(table)
        tables.append(table)

    page.section("Summary")
    page.facts(summary.facts(study))
    page.remarks(summary.remarks(study, unreadable))
    page.paragraph(summary.shared_sentence(study), soft=True)
    tabulate(summary.seed_table(study, num_seeds))

    page.section("Learning curves")
    for over, title in (("frame", "frames"), ("hours", "hours")):
        page.heading(f"By {title}")
        sheet, curves = results.curve_sheet(
            study, study.groups, name=f"learning_by_{title}", over=over
        )
        show(sheet, "No run has an evaluation yet.")
        tables.append(results.curve_table(f"learning_by_{title}", curves, over))

    page.section("Final returns")
    page.paragraph(
        "The paper averages the last ten episodes. Here it is the last evaluation: as "
        "many episodes as num_eval_episodes says, ten by default, played by the mean "
        "action. IQM is the interquartile mean, its interval a bootstrap over seeds."
    )
    finals = results.finals(study, study.groups)
    show(results.bar_sheet(study, finals, name="final_returns"), "No evaluation yet.")
    tabulate(results.final_table(finals))
    aggregate = results.aggregate_table(finals)
    if aggregate is not None:
        page.heading("Over all tasks, in shares of each expert")
        page.paragraph(
            "Seeds are resampled within each task (stratified bootstrap). Variants "
            "that were not run on the same tasks can't be compared by these rows.",
            soft=True,
        )
        tabulate(aggregate)

    page.section("Distance to the expert")
    page.paragraph(
        "Wasserstein distance between the episodes of agent and expert; a random "
        "policy has 1, the expert 0."
    )
    sheet, curves = results.curve_sheet(
        study,
        study.groups,
        name="wasserstein",
        over="frame",
        column="wasserstein_to_expert",
    )
    show(sheet, "No run has a column wasserstein_to_expert in its eval.csv.")
    if curves:
        tables.append(results.curve_table("wasserstein", curves, "frame"))

    page.section("Sample efficiency")
    page.paragraph(
        "When the first evaluation was at or above a share of the expert's return: the "
        "share of seeds that got there, and the median over seeds, of which those that "
        "never did count as later than all others. Frames per second are of the whole "
        "run, evaluations included."
    )
    tabulate(results.efficiency_table(study))

    page.section("Runs")
    tabulate(results.run_table(study))

    page.section("Videos")
    films, left_out = episodes.collect(study, num_videos)
    page.remarks(left_out)
    if films:
        page.episodes(films)
        drawn.extend(film.sheet for film in films if film.sheet)
    else:
        page.paragraph("No run has a video that can be shown.", soft=True)
    page.heading("What the discriminator says")
    show(
        results.logit_sheet(study, name="logits"),
        "No run has logits of a discriminator in its train.csv.",
    )

    page.section("The paper's figures")
    page.paragraph(
        "Figures of the paper by their numbers, as far as there are runs; runs with "
        "other settings than the paper's are drawn as well, see Runs."
    )
    found = paper.paper_figures(study, num_seeds)
    page.paper(found, num_seeds)
    drawn.extend(figure.sheet for figure in found if figure.sheet)

    with folders.replaced(output) as folder:
        for sheet in drawn:
            write(sheet, folder / "figures")
        for table in tables:
            (folder / "tables" / f"{table.name}.csv").write_bytes(to_csv(table))
        (folder / "index.html").write_bytes(page.html())


def _tasks(study: results.Study) -> str:
    tasks = list(groups.tasks_of(study.groups))
    return ", ".join(tasks) if len(tasks) <= 3 else f"{len(tasks)} tasks"
