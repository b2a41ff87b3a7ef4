"""Groups of seeds with equal settings: their labels and their look in figures."""

import colorsys
import re
import string
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colors

from jaxil import config as jaxil_config
from jaxil.reporting import figures
from jaxil.reporting.runs import Run, defaults_of

_SAME_EXPERT = 1e-3  # relative; the renderer's rounding is far below
_MAX_SHOWN = 60  # characters of one value
_MAX_WORDS = 3  # of a label, after its method
# How lines of one method differ: dashes in line widths, marker, and lightness added to
# the method's own. Five and six have no common factor: thirty lines differ.
_DASHES = ((), (4.0, 1.5), (1.0, 1.3), (5.0, 1.5, 1.0, 1.5), (7.0, 2.0), (2.5, 1.0))
_MARKERS = ("o", "s", "^", "D", "v", "P")
_LIGHTNESS = (0.0, 0.17, -0.07, 0.25, 0.09)
_GREY = "#5b5b5b"
_DARKEST, _BRIGHTEST = 0.27, 0.85  # visible on dark and on bright pages


class Look(NamedTuple):
    """How a group is plotted."""

    colour: str  # as "#rrggbb"
    dashes: tuple[float, ...]  # lengths on and off, in line widths; empty: solid
    marker: str  # of single points, in Matplotlib's letters

    @property
    def line(self) -> Any:
        """The dashes as Matplotlib's line style."""
        return (0, self.dashes) if self.dashes else "-"


class Group(NamedTuple):
    """Seeds of one variant on one task, with the same settings."""

    task: str
    variant: figures.Variant
    # Those that differ from the paper's and, on some task, among the runs of the same
    # variant, such as "action_repeat 4".
    settings: tuple[str, ...]
    # The variant with its settings, or with a letter in their place where that takes
    # more than three words; the same on every task. The name of its method is added
    # where another has the same label.
    label: str
    look: Look  # the same for all groups of this label
    runs: tuple[Run, ...]  # by seed and folder, at least one

    @property
    def measured(self) -> tuple[Run, ...]:
        """The runs with at least one evaluation."""
        return tuple(run for run in self.runs if len(run.returns))

    @property
    def num_finished(self) -> int:
        """How many runs have used up their frames."""
        return sum(run.is_finished for run in self.runs)


def make_groups(runs: Iterable[Run]) -> list[Group]:
    """Sorts runs into groups, in the paper's order of tasks and methods."""
    families: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        variant = run.variant
        families.setdefault((variant.method, variant.label), []).append(run)
    found: dict[tuple, list[Run]] = {}
    for (method, label), family in families.items():
        differing = differing_fields(family)
        for run in family:
            settings = tuple(
                f"{field} {short(value)}"
                for field, value in changes(run).items()
                if field in differing
            )
            found.setdefault((run.task, method, label, settings), []).append(run)

    def order(key: tuple) -> tuple:
        task, method, label, settings = key
        return (
            task_order(task),
            figures.declaration(method).rank,
            method,
            len(found[key][0].variant.overrides),
            [_by_number(text) for text in (label, *settings)],
        )

    ordered = sorted(found, key=order)
    labels = _labels(key[1:] for key in ordered)
    looks = _looks((figures.declaration(key[0]).colour, k) for key, k in labels.items())
    groups = []
    for key in ordered:
        members = tuple(sorted(found[key], key=lambda run: (run.seed, run.name)))
        task, _, _, settings = key
        label, variant = labels[key[1:]], members[0].variant
        groups.append(Group(task, variant, settings, label, looks[label], members))
    return groups


def differing_fields(runs: Sequence[Run]) -> list[str]:
    """Returns the settings that matter to all of the runs and differ within a task.

    Presets set some of them for each task, which a task's name already says.
    """

    num_tasks = len({run.task for run in runs})
    found = []
    for field in sorted({field for run in runs for field in run.config}):
        values = {(run.task, repr(run.config.get(field))) for run in runs}
        matters = all(_has(run, field) and _matters(run, field) for run in runs)
        if matters and len(values) > num_tasks:  # some task has two values
            found.append(field)
    return found


def changes(run: Run) -> dict[str, Any]:
    """Returns the settings that differ from the paper's, by dotted name."""
    paper = defaults_of(run.variant.method, run.task)
    return {
        field: value
        for field, value in sorted(run.config.items())
        if _matters(run, field) and repr(paper.get(field)) != repr(value)
    }


def short(value: Any) -> str:
    """Returns a setting's value in brief, such as "5M" or "(1, 2)"."""
    if isinstance(value, int) and not isinstance(value, bool):
        if value and value % 1000 == 0:
            return f"{value // 1000}k" if value % 1_000_000 else f"{value // 10**6}M"
        return str(value)
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return "(" + ", ".join(map(short, value))[:_MAX_SHOWN] + ")"
    if isinstance(value, str) and value and value.isprintable():
        return value[:_MAX_SHOWN]
    return ascii(value)[:_MAX_SHOWN]


def task_order(task: str) -> tuple[int, str]:
    """Returns a key that sorts the paper's tasks in its order, then others by name."""
    tasks = figures.TASKS
    return (tasks.index(task) if task in tasks else len(tasks), task)


def expert_returns(groups: Iterable[Group]) -> list[tuple[float, list[str]]]:
    """Returns the different experts of one task's runs, the best one first.

    Each is its mean return, with the labels of the groups that imitate it.
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


def tasks_of(groups: Iterable[Group]) -> dict[str, list[Group]]:
    """Returns the groups of each task, in the order in which they come."""
    tasks: dict[str, list[Group]] = {}
    for group in groups:
        tasks.setdefault(group.task, []).append(group)
    return tasks


def _has(run: Run, field: str) -> bool:
    # An older run may lack a field that its method has today.
    method = run.variant.method
    return field in run.config or (
        figures.installed(method) is not None and field in jaxil_config.fields(method)
    )


def _matters(run: Run, field: str) -> bool:
    variations = figures.declaration(run.variant.method).variations
    # The label or the panel already shows these.
    named = ("method", "task", figures.DEMONSTRATIONS, *(v.field for v in variations))
    return field not in (*jaxil_config.FREE_FIELDS, "seed", *named)


def _labels(keys: Iterable[tuple[str, str, tuple[str, ...]]]) -> dict[tuple, str]:
    """Names each (method, label, settings): a letter stands for several settings."""
    found: dict[tuple, str] = {}
    owners: dict[str, str] = {}  # methods by label
    letters: Counter[tuple[str, str]] = Counter()
    for key in keys:
        method, label, settings = key
        if key in found:
            continue
        if owners.setdefault(label, method) != method:
            label = f"{label} [{method}]"
        text = f"{label} ({', '.join(settings)})" if settings else label
        plain = figures.declaration(method).label
        if settings and len(text.removeprefix(plain).split()) > _MAX_WORDS:
            cycle, index = divmod(letters[method, label], len(string.ascii_uppercase))
            letters[method, label] += 1
            text = f"{label} ({string.ascii_uppercase[index]}{cycle or ''})"
        found[key] = text
    return found


def _looks(coloured: Iterable[tuple[str, str]]) -> dict[str, Look]:
    """Returns the look of each label, from pairs (colour of its method, label)."""
    looks: dict[str, Look] = {}
    counts: Counter[str] = Counter()
    for colour, label in coloured:
        index = counts[colour]
        counts[colour] += 1
        looks[label] = Look(
            _shade(colour, _LIGHTNESS[index % len(_LIGHTNESS)]),
            _DASHES[index % len(_DASHES)],
            _MARKERS[index % len(_MARKERS)],
        )
    return looks


def _shade(colour: str, change: float) -> str:
    rgb = colors.to_rgb(colour if colors.is_color_like(colour) else _GREY)
    hue, lightness, saturation = colorsys.rgb_to_hls(*rgb)
    lightness = min(max(lightness + change, _DARKEST), _BRIGHTEST)
    return colors.to_hex(colorsys.hls_to_rgb(hue, lightness, saturation))


def _by_number(text: str) -> list[tuple[int, float, str]]:
    """Returns a key that sorts "10 demonstrations" after "2 demonstrations"."""
    parts = re.split(r"(\d+)", text)
    return [(1, float(p), "") if p.isdigit() else (0, 0.0, p) for p in parts]
