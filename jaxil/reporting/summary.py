"""What a reader should know before the figures: what is there, odd or missing."""

from collections import Counter
from collections.abc import Iterator

from jaxil.reporting.groups import (
    differing_fields,
    duplicate_seeds,
    expert_returns,
    settings_text,
    task_order,
    tasks_of,
)
from jaxil.reporting.results import Study, shared_changes
from jaxil.reporting.tables import Column, Table


def facts(study: Study) -> list[tuple[str, str]]:
    """Returns the numbers at the head of the page, with what they count."""
    runs = study.runs
    methods = {group.variant.method for group in study.groups}
    hours = sum(run.seconds for run in runs) / 3600
    return [
        (f"{len(runs)}", "run" if len(runs) == 1 else "runs"),
        (f"{sum(run.is_finished for run in runs)}", "of them finished"),
        (f"{len({run.task for run in runs})}", "tasks"),
        (f"{len(methods)}", "methods"),
        (f"{len({run.seed for run in runs})}", "different seeds"),
        (f"{sum(run.frames for run in runs) / 1e6:.2f} M", "frames"),
        (f"{hours:.1f}", "hours"),
    ]


def seed_table(study: Study, num_seeds: int) -> Table:
    """Returns which seeds each variant has on each task, and which it lacks.

    Args:
      study: all runs.
      num_seeds: how many each should have: seeds 0 to num_seeds - 1.
    """
    columns = (
        Column("task", "task"),
        Column("variant", "variant"),
        Column("seeds", "seeds"),
        Column("finished", "finished", "count"),
        Column("unfinished", "unfinished", "count"),
        Column("empty", "empty", "count"),
        Column("missing", f"missing of {num_seeds}"),
    )
    rows = []
    for group in study.groups:
        seeds = sorted({run.seed for run in group.runs})
        empty = sum(run.frames == 0 for run in group.runs)
        rows.append(
            (
                group.task,
                group.label,
                _ranges(seeds),
                group.num_finished,
                len(group.runs) - group.num_finished - empty,
                empty,
                _ranges(sorted(set(range(num_seeds)) - set(seeds))),
            )
        )
    return Table("seeds", columns, rows)


def shared_sentence(study: Study) -> str:
    """Says in which settings all runs are unlike the paper's."""
    shared = shared_changes(study)
    if not shared:
        return ""
    return (
        "All runs differ from the paper's settings in: "
        f"{settings_text(shared, shared)}."
    )


def remarks(study: Study, unreadable: list[str]) -> list[str]:
    """Returns one sentence for each thing that a reader should know.

    Args:
      study: all runs.
      unreadable: sentences about folders that were skipped.
    """
    return [*unreadable, *_about_runs(study), *_about_groups(study)]


def _about_runs(study: Study) -> Iterator[str]:
    found: dict[str, list[str]] = {}
    for run in study.runs:
        for remark in run.remarks:
            found.setdefault(remark, []).append(run.name)
    for remark, names in found.items():
        yield f"{remark}: {_some(names)}"
    unfinished = [r.name for r in study.runs if not r.is_finished and r.frames > 0]
    if unfinished:
        yield f"unfinished, shown as far as they are: {_some(unfinished)}"


def _about_groups(study: Study) -> Iterator[str]:
    for group in study.groups:
        for seed, names in duplicate_seeds(group).items():
            yield (
                f"{group.task}, {group.label}: seed {seed} is there {len(names)} times "
                f"and counts as often: {_some(names)}"
            )
    single = Counter(group.task for group in study.groups if len(group.measured) == 1)
    if single:
        tasks = sorted(single, key=task_order)
        yield (
            "single seeds, which say nothing about variance, have no band: "
            + ", ".join(f"{single[task]} on {task}" for task in tasks)
        )
    for task, groups in tasks_of(study.groups).items():
        experts = expert_returns(groups)
        if len(experts) > 1:
            each = "; ".join(f"{value:.1f} for {_some(k)}" for value, k in experts)
            yield (
                f"{task}: the runs imitate different experts, and shares are of each "
                f"run's own: {each}"
            )
        if not experts:
            yield f"{task}: no run names an expert's return"
        elif any(not e for e in [expert_returns([g]) for g in groups if g.measured]):
            lacking = [
                g.label for g in groups if g.measured and not expert_returns([g])
            ]
            which = (
                "are measured against the other runs' expert"
                if len(experts) == 1
                else "have no shares of an expert"
            )
            yield f"{task}: without demonstrations, {_some(lacking)} {which}"
        named = {field for group in groups for field in group.variant.overrides}
        runs = [run for group in groups for run in group.runs]
        methods = {group.variant.slug for group in groups}
        fields = [field for field in differing_fields(runs) if field not in named]
        if len(methods) > 1 and fields:
            yield f"{task}: what is compared differs also in {', '.join(fields)}"
    devices = Counter(run.device for run in study.runs)
    if len(devices) > 1:
        each = ", ".join(f"{name} ({count})" for name, count in sorted(devices.items()))
        yield f"hours are of different devices: {each}"


def _some(names: list[str], most: int = 6) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _ranges(numbers: list[int]) -> str:
    """Writes [0, 1, 2, 5] as "0-2, 5"."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and parts[-1][-1] == number - 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(f"{p[0]}-{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts)
