"""The report's tables, as CSV with every digit and as text on the page."""

import csv
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxil.reporting import statistics
from jaxil.reporting.groups import Group, changes
from jaxil.reporting.measures import (
    EARLY_FRAMES,
    LEVELS,
    Curve,
    Early,
    Final,
    arrivals,
    early,
)

_NAN = float("nan")
_REAL = (float, np.floating, np.ndarray)  # the last of no axes
_PERCENTS = [f"{level * 100:.0f}" for level in LEVELS]
# Columns of numbers by their format on the page, and titles that differ from the name.
_COUNTS = ["runs", "tasks", "finished", "unfinished", "empty", "seed", "frames"]
_COUNTS += [f"frames_{percent}" for percent in _PERCENTS]
_RETURNS = ["mean", "mean_low", "mean_high", "iqm", "iqm_low", "iqm_high", "median"]
_RETURNS += ["expert", "expert_return", "last_return", "best_return"]
_RETURNS += ["frames_per_second"]
_EARLY = f"share_to_{EARLY_FRAMES // 1000}k"
_SHARES = ["share_of_expert", *(f"reached_{percent}" for percent in _PERCENTS)]
_SHARES += [_EARLY, f"{_EARLY}_low", f"{_EARLY}_high"]
_HOURS = ["hours", *(f"hours_{percent}" for percent in _PERCENTS)]
_FORMATS = {
    **dict.fromkeys(_COUNTS, ",.0f"),
    **dict.fromkeys(_RETURNS, ".1f"),
    **dict.fromkeys(_SHARES, ".0%"),
    **dict.fromkeys(_HOURS, ".2f"),
}
_TITLES = {
    "share_of_expert": "of the expert",
    "frames_per_second": "frames/s",
    "iqm": "IQM",
    _EARLY: f"IQM to {EARLY_FRAMES:,} frames",
    **{f"{estimate}_low": "90 % from" for estimate in ("mean", "iqm", _EARLY)},
    **{f"{estimate}_high": "to" for estimate in ("mean", "iqm", _EARLY)},
    **{f"reached_{percent}": f"reached {percent} %" for percent in _PERCENTS},
    **{f"frames_{percent}": f"{percent} % after frames" for percent in _PERCENTS},
    **{f"hours_{percent}": f"{percent} % after hours" for percent in _PERCENTS},
}


class Table(NamedTuple):
    """Rows of cells, of which None and NaN are missing."""

    name: str  # of its file
    title: str  # on the page
    rows: Sequence[dict[str, Any]]  # by the columns' names in the file, all the same
    about: str = ""  # how to read it
    in_shares: bool = False  # whether its means are shares of an expert's return

    @property
    def columns(self) -> list[str]:
        """The names of the columns, if there are rows."""
        return list(self.rows[0])


def to_csv(table: Table) -> bytes:
    """Returns the table with every digit; missing cells are empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, table.columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: exact(cell) for k, cell in row.items()} for row in table.rows)
    return stream.getvalue().encode(errors="replace")


def title(column: str) -> str:
    """Returns a column's name on the page."""
    return _TITLES.get(column, column.replace("_", " "))


def is_number(column: str) -> bool:
    """Returns whether a column holds numbers."""
    return column in _FORMATS


def shown(table: Table, column: str, cell: Any) -> str:
    """Returns a cell as text on the page."""
    if _is_missing(cell):
        return "–"
    kind = _FORMATS.get(column, "")
    if table.in_shares and column in _RETURNS:
        kind = ".0%"
    return f"{cell:{kind}}".replace("%", " %") if kind else str(cell)


def exact(cell: Any) -> Any:
    """Returns a cell with every digit; "" if it is missing."""
    if _is_missing(cell):
        return ""
    if isinstance(cell, _REAL):
        number = float(cell)
        whole = number.is_integer() and abs(number) < 1e15
        return int(number) if whole else repr(number)
    return cell


def _is_missing(cell: Any) -> bool:
    return cell is None or (isinstance(cell, _REAL) and bool(np.isnan(cell)))


def curve_table(name: str, curves: Sequence[Curve]) -> Table:
    """Returns the points of the curves."""
    rows = []
    for line in curves:
        points = zip(line.x, line.count, *line.mean, strict=True)
        for x, count, mean, low, high in points:
            row = {"task": line.group.task, "variant": line.group.label, line.over: x}
            row |= {"seeds": int(count), "mean": mean, "low": low, "high": high}
            rows.append(row)
    return Table(name, name, rows)


def final_table(finals: Sequence[Final]) -> Table:
    """Returns the last returns of each group."""
    rows = [
        {
            "task": each.group.task,
            "variant": each.group.label,
            "runs": len(each.returns),
            "finished": each.group.num_finished,
            **_interval("mean", each.mean),
            **_interval("iqm", statistics.interquartile_interval([each.returns])),
            "median": np.median(each.returns),
            "expert": each.expert,
            "share_of_expert": np.mean(each.shares),
        }
        for each in finals
    ]
    about = (
        "The paper averages the last ten episodes; this is the last evaluation, of as "
        "many episodes as num_eval_episodes says (default: 10), by the mean action. "
        "IQM is the interquartile mean, with a bootstrap interval over seeds."
    )
    return Table("final_returns", "Final returns", rows, about)


def aggregate_table(finals: Sequence[Final]) -> Table:
    """Returns each variant over its tasks, at least two, in shares of their experts."""
    labels: dict[str, list[np.ndarray]] = {}
    for each in finals:
        if np.isfinite(each.shares).all():
            labels.setdefault(each.group.label, []).append(each.shares)
    rows = []
    for label, strata in labels.items():
        if len(strata) < 2:
            continue
        scores = np.concatenate(strata)
        row = {"variant": label, "tasks": len(strata), "runs": len(scores)}
        row |= _interval("iqm", statistics.interquartile_interval(strata))
        rows.append({**row, "median": np.median(scores), "mean": scores.mean()})
    about = (
        "Seeds are resampled within each task (stratified bootstrap). Variants with "
        "runs on different tasks cannot be compared here. Settings may differ from "
        "task to task, as those of presets do."
    )
    name = "Over all tasks, in shares of each expert"
    return Table("all_tasks", name, rows, about, in_shares=True)


def efficiency_table(groups: Sequence[Group]) -> Table:
    """Returns when each group reached shares of its expert's return."""
    rows = []
    for group in groups:
        runs = group.measured
        if not runs:
            continue
        frames = [arrivals(run, "frame") for run in runs]
        hours = [arrivals(run, "hours") for run in runs]
        has_shares = any(run.expert_return > 0 for run in runs)
        row = {"task": group.task, "variant": group.label, "runs": len(runs)}
        for k, percent in enumerate(_PERCENTS):
            reached = np.isfinite([each[k] for each in frames]).mean()
            row[f"reached_{percent}"] = reached if has_shares else _NAN
            for unit, times in (("frames", frames), ("hours", hours)):
                median = statistics.median_arrival([each[k] for each in times])
                row[f"{unit}_{percent}"] = median
        soon = early(group)
        row |= _interval(_EARLY, soon.iqm if soon else [_NAN] * 3)
        speeds = [run.frames_per_second for run in runs]
        rows.append({**row, "frames_per_second": np.median(speeds)})
    about = (
        "When an evaluation first reached a share of the expert's return: the share of "
        "seeds that did, and the median over seeds, where those that never did count "
        "as later than all others. IQM: of the mean share of the expert's return up to "
        f"{EARLY_FRAMES:,} frames, over the seeds that are as long. Frames per second "
        "include evaluations."
    )
    return Table("sample_efficiency", "Sample efficiency", rows, about)


def early_table(joined: Sequence[Early], num_tasks: int) -> Table:
    """Returns how soon each variant learns over all tasks; see `early_over_tasks`."""
    rows = []
    for each in joined:
        row = {"variant": each.group.label, "tasks": num_tasks}
        row |= {"runs": len(each.shares), **_interval(_EARLY, each.iqm)}
        rows.append(row)
    about = (
        "The IQM of the table above over all tasks, for variants with runs on each of "
        "them. Seeds are resampled within each task."
    )
    name = "Sample efficiency over all tasks"
    return Table("sample_efficiency_all_tasks", name, rows, about)


def seed_table(groups: Sequence[Group], num_seeds: int | None) -> Table:
    """Returns which seeds each variant has on each task.

    And which of 0 to `num_seeds` - 1 are missing, unless that is None.
    """
    rows = []
    for group in groups:
        seeds = sorted({run.seed for run in group.runs})
        empty = sum(run.frames == 0 for run in group.runs)
        row = {
            "task": group.task,
            "variant": group.label,
            "seeds": _ranges(seeds),
            "finished": group.num_finished,
            "unfinished": len(group.runs) - group.num_finished - empty,
            "empty": empty,
        }
        if num_seeds is not None:
            row["missing"] = _ranges(sorted(set(range(num_seeds)) - set(seeds)))
        rows.append(row)
    return Table("seeds", "Seeds", rows)


def settings_table(groups: Sequence[Group]) -> Table:
    """Returns what the letters behind a variant's name stand for."""
    settings = {
        group.label: ", ".join(group.settings)
        for group in groups
        if group.settings and not group.label.endswith(f"({', '.join(group.settings)})")
    }
    rows = [{"variant": label, "settings": text} for label, text in settings.items()]
    return Table("settings", "Settings behind the letters", rows)


def run_table(groups: Sequence[Group]) -> Table:
    """Returns one row for each run."""
    runs = [(group, run) for group in groups for run in group.runs]
    shared = shared_changes(groups)
    rows = []
    for group, run in runs:
        own = {k: v for k, v in changes(run).items() if k not in shared}
        row = {
            "folder": run.name,
            "task": run.task,
            "variant": group.label,
            "seed": run.seed,
            "state": run.state,
            "frames": run.frames,
            "hours": run.seconds / 3600,
            "frames_per_second": run.frames_per_second,
            "last_return": run.returns[-1] if len(run.returns) else _NAN,
            "best_return": run.returns.max() if len(run.returns) else _NAN,
            "expert_return": run.expert_return,
        }
        for percent, frames in zip(_PERCENTS, arrivals(run, "frame"), strict=True):
            row[f"frames_{percent}"] = frames
        row["device"] = run.device
        row["settings"] = ", ".join(f"{k}={v}" for k, v in own.items())
        row["remarks"] = "; ".join(run.remarks)
        rows.append(row)
    about = "Settings are those that differ from the paper's and not in all runs."
    return Table("runs", "Runs", rows, about)


def shared_changes(groups: Sequence[Group]) -> dict[str, Any]:
    """Returns the settings, not the paper's, that all runs have in common."""
    first, *others = [changes(run) for group in groups for run in group.runs]
    return {k: v for k, v in first.items() if all(o.get(k) == v for o in others)}


def _interval(key: str, estimate: Sequence[Any]) -> dict[str, Any]:
    value, low, high = estimate
    return {key: value, f"{key}_low": low, f"{key}_high": high}


def _ranges(numbers: list[int]) -> str:
    """Writes [0, 1, 2, 5] as "0-2, 5"."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and parts[-1][-1] == number - 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(f"{p[0]}-{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts)
