"""Warnings for the reader: unusual runs, and what limits comparisons."""

from collections import Counter
from collections.abc import Iterator, Sequence

from jaxil.reporting.groups import (
    Group,
    differing_fields,
    expert_returns,
    task_order,
    tasks_of,
)

_MAX_NAMES = 6  # of runs or groups, in one warning


def remarks(groups: Sequence[Group]) -> list[str]:
    """Returns the warnings, one sentence each."""
    return [*_about_runs(groups), *_about_groups(groups), *_about_tasks(groups)]


def _about_runs(groups: Sequence[Group]) -> Iterator[str]:
    runs = [run for group in groups for run in group.runs]
    found: dict[str, list[str]] = {}
    for run in runs:
        for remark in run.remarks:
            found.setdefault(remark, []).append(run.name)
    for remark, names in found.items():
        yield f"{remark}: {_listed(names)}"
    unfinished = [r.name for r in runs if not r.is_finished and r.frames > 0]
    if unfinished:
        yield f"unfinished, shown as far as they are: {_listed(unfinished)}"
    devices = Counter(run.device for run in runs)
    if len(devices) > 1:
        each = [f"{name} ({count})" for name, count in sorted(devices.items())]
        yield f"hours were measured on different devices: {_listed(each)}"


def _about_groups(groups: Sequence[Group]) -> Iterator[str]:
    for group in groups:
        for seed, count in Counter(run.seed for run in group.runs).items():
            if count > 1:
                names = [run.name for run in group.runs if run.seed == seed]
                yield (
                    f"{group.task}, {group.label}: {count} runs have seed {seed}, and "
                    f"each counts: {_listed(names)}"
                )
    single = Counter(group.task for group in groups if len(group.measured) == 1)
    if single:
        each = [f"{single[task]} on {task}" for task in sorted(single, key=task_order)]
        yield f"single seeds, which have no interval: {_listed(each)}"


def _about_tasks(groups: Sequence[Group]) -> Iterator[str]:
    for task, task_groups in tasks_of(groups).items():
        experts = expert_returns(task_groups)
        if len(experts) > 1:
            each = "; ".join(f"{value:.1f} for {_listed(k)}" for value, k in experts)
            yield (
                f"{task}: the runs imitate different experts, and each run is compared "
                f"with its own: {each}"
            )
        measured = [group for group in task_groups if group.measured]
        lacking = [group.label for group in measured if not expert_returns([group])]
        if lacking:
            yield (
                f"{task}: no expert's return is known for {_listed(lacking)}, so no "
                "share of it is shown"
            )
        named = {field for group in task_groups for field in group.variant.overrides}
        runs = [run for group in task_groups for run in group.runs]
        fields = [field for field in differing_fields(runs) if field not in named]
        if len({run.variant.label for run in runs}) > 1 and fields:
            yield f"{task}: compared runs also differ in {', '.join(fields)}"


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return ", ".join(names[:_MAX_NAMES]) + more
