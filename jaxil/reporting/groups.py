"""Which runs are seeds of one thing, and what that thing is called."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxil.reporting import figures
from jaxil.reporting.runs import Run, paper_settings

# Runs that differ in nothing else are seeds of one thing. From the third on they decide
# what is kept on disk, or how fast it comes, not what is learned.
_FREE_FIELDS = (
    "seed",
    "total_frames",
    "checkpoint_every_frames",
    "video_every_evals",
    "encoder.convolutions",
    "replay_on_device",
    "encoder.chunk_size",  # of older runs
)
# The name of the variant, or of the panel, says these already.
_NAMED_FIELDS = (
    "method",
    "task",
    "demonstrations.num_episodes",
    "discriminator.sees_actions",
    "sinkhorn.cost",
    "sinkhorn.alignment",
)
# Settings of one method change nothing about another.
_METHODS_OF = {"sinkhorn": ("psil", "sil"), "discriminator": ("pdac", "dac")}
_SAME_EXPERT = 1e-3  # relative; the renderer's rounding is far below


class Group(NamedTuple):
    """Seeds of one variant on one task, with the same settings.

    Attributes:
      task: such as "walker_walk".
      variant: the method with what an ablation changed.
      settings: what tells it from other groups of the same variant and task, such as
        "action_repeat 4"; empty if there is no other.
      runs: by seed and folder, at least one.
    """

    task: str
    variant: figures.Variant
    settings: str
    runs: tuple[Run, ...]

    @property
    def label(self) -> str:
        """What figures and tables call it."""
        return label_of(self.variant, self.settings)

    @property
    def measured(self) -> tuple[Run, ...]:
        """The runs with at least one evaluation."""
        return tuple(run for run in self.runs if len(run.returns))

    @property
    def num_finished(self) -> int:
        """How many runs have used up their frames."""
        return sum(run.is_finished for run in self.runs)


def label_of(variant: figures.Variant, settings: str) -> str:
    """Returns the name of a variant with settings of its own."""
    return f"{variant.label} ({settings})" if settings else variant.label


def make_groups(runs: Iterable[Run]) -> list[Group]:
    """Sorts runs into groups, in the paper's order of tasks and methods."""
    families: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        families.setdefault((run.task, run.variant.slug), []).append(run)
    groups = []
    for (task, _), family in families.items():
        fields = differing_fields(family)
        parts: dict[str, list[Run]] = {}
        for run in family:
            parts.setdefault(settings_text(run.config, fields), []).append(run)
        for settings, part in parts.items():
            ordered = tuple(sorted(part, key=lambda run: (run.seed, run.name)))
            groups.append(Group(task, ordered[0].variant, settings, ordered))
    return sorted(groups, key=lambda g: (task_order(g.task), label_order(g)))


def differing_fields(runs: Sequence[Run]) -> list[str]:
    """Returns the settings that matter to all of the runs and differ among them."""
    fields = {field for run in runs for field in run.config}
    return sorted(
        field
        for field in fields
        if all(_matters(run, field) for run in runs)
        and len({repr(run.config.get(field)) for run in runs}) > 1
    )


def changes(run: Run) -> dict[str, Any]:
    """Returns the settings that are not the paper's, by dotted name."""
    paper = paper_settings(run)
    return {
        field: value
        for field, value in sorted(run.config.items())
        if _matters(run, field) and repr(paper.get(field)) != repr(value)
    }


def settings_text(config: Mapping[str, Any], fields: Iterable[str]) -> str:
    """Returns fields with their values for people, such as "batch_size 64"."""
    return ", ".join(f"{field} {_short(config.get(field))}" for field in fields)


def task_order(task: str) -> tuple[int, str]:
    """Sorts tasks: the paper's, in its order, then others by name."""
    tasks = figures.TASKS
    return (tasks.index(task) if task in tasks else len(tasks), task)


def label_order(group: Group) -> tuple:
    """Sorts groups of a task: by method, plain ones first."""
    variant = group.variant
    methods = list(figures.METHOD_NAMES)
    return (
        methods.index(variant.method),
        len(variant.overrides),
        _by_number(variant.label),
        _by_number(group.settings),
    )


def expert_returns(groups: Iterable[Group]) -> list[tuple[float, list[str]]]:
    """Returns the different experts of one task's runs.

    Returns:
      Mean return of each, falling, with the labels of the groups that imitate it.
    """
    experts: list[tuple[float, list[str]]] = []
    found = [
        (run.expert_return, group.label)
        for group in groups
        for run in group.runs
        if np.isfinite(run.expert_return)
    ]
    for value, label in sorted(found, reverse=True):
        if not experts or experts[-1][0] - value > _SAME_EXPERT * abs(value):
            experts.append((value, []))
        if label not in experts[-1][1]:
            experts[-1][1].append(label)
    return experts


def duplicate_seeds(group: Group) -> dict[int, list[str]]:
    """Returns the seeds that more than one run has, with these runs' names."""
    counts = Counter(run.seed for run in group.runs)
    return {
        seed: [run.name for run in group.runs if run.seed == seed]
        for seed, count in counts.items()
        if count > 1
    }


def tasks_of(groups: Iterable[Group]) -> dict[str, list[Group]]:
    """Returns the groups of each task, in the order in which they come."""
    tasks: dict[str, list[Group]] = {}
    for group in groups:
        tasks.setdefault(group.task, []).append(group)
    return tasks


def _matters(run: Run, field: str) -> bool:
    group = field.split(".")[0]
    is_own = run.variant.method in _METHODS_OF.get(group, (run.variant.method,))
    return is_own and field not in (*_FREE_FIELDS, *_NAMED_FIELDS)


def _short(value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        if value and value % 1000 == 0:
            return f"{value // 1000}k" if value % 1_000_000 else f"{value // 10**6}M"
        return str(value)
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return "(" + ", ".join(map(_short, value)) + ")"
    return "''" if value == "" else str(value)


def _by_number(text: str) -> list[tuple[int, float, str]]:
    """Makes "10 demonstrations" come after "1 demonstration"."""
    parts = re.split(r"(\d+)", text)
    return [(1, float(p), "") if p.isdigit() else (0, 0.0, p) for p in parts]
