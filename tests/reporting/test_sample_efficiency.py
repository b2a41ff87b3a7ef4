"""How soon methods learn, for each task and over all of them."""

import numpy as np

from jaxil.reporting import charts, measures, tables
from tests.reporting.run_folders import groups_below, write_run


def test_how_soon_methods_learn_is_joined_over_the_tasks_that_they_share(tmp_path):
    # From 0 straight to the expert's 1000 at 100k: 50 % in the mean; and so on.
    write_run(tmp_path / "a", "pdac", "cartpole_swingup", 0, {100_000: 1000})
    write_run(tmp_path / "b", "pdac", "cartpole_swingup", 1, {100_000: 800})
    write_run(tmp_path / "c", "pdac", "walker_walk", 0, {100_000: 200})
    write_run(tmp_path / "d", "psil", "cartpole_swingup", 0, {100_000: 600})
    write_run(tmp_path / "e", "psil", "walker_walk", 0, {90_000: 1000})  # too short

    tasks = measures.early_by_task(groups_below(tmp_path))
    joined = measures.early_over_tasks(tasks)
    (row,) = tables.early_table(joined, len(tasks)).rows
    shown = {key: row[key] for key in ("variant", "tasks", "runs")}
    assert shown == {"variant": "P-DAC", "tasks": 2, "runs": 3}
    # Of 0.1, 0.4 and 0.5; with the bootstrap's 0.4 or 0.5 twice at its ends.
    ends = [row[f"share_to_100k{end}"] for end in ("", "_low", "_high")]
    np.testing.assert_allclose(ends, [1 / 3, 0.3, 1.1 / 3])

    sheet = charts.early_sheet(tasks, joined)
    assert sheet is not None
    titles = [panel.title for panel in sheet.panels]
    assert titles == ["2 tasks together", "cartpole_swingup", "walker_walk"]
    one = {"walker_walk": tasks["walker_walk"]}
    assert not measures.early_over_tasks(one)  # nothing to join
    assert charts.early_sheet({}, []) is None
