"""What a method declares about itself, and whether that can be used."""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from jaxil.errors import Fault, unknown_name

# The types of fields that --config.FIELD=TEXT can be read as, and their names.
KINDS = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "text",
    tuple: "a list in brackets, such as (32,32)",
}
# Columns of train.csv that the learner writes begin so, or contain no slash.
_LEARNER_GROUPS = ("critic/", "actor/", "batch/", "replay/")


class Field(NamedTuple):
    """One setting.

    Attributes:
      default: the paper's value, or the reference's; its type is the field's.
      about: what it is and what is usual, for `--help` and messages.
      low: smallest value of a number.
      high: largest value of a number.
      choices: of a name; empty if any text will do.
      positive: whether a number must lie above `low`, not at it.
      at_most: a number's upper bound as another field, one that every config has;
        empty if there is none.
    """

    default: Any
    about: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    positive: bool = False
    at_most: str = ""


class Variation(NamedTuple):
    """A field that makes an ablation of the method.

    Attributes:
      field: dotted, such as "sinkhorn.cost".
      plain: the value of the method itself.
      words: what figures call another value; "{}" stands for it, and is needed where
        there are several.
    """

    field: str
    plain: Any
    words: str


class Method(NamedTuple):
    """What jaxil knows about a method.

    Attributes:
      name: how configs name it; `get` sets package.module:METHOD if it is not `known`.
      label: how figures and tables name it.
      about: what it learns from, in a few words.
      colour: of its curves, "#rrggbb".
      rank: its place in tables and legends: small numbers first.
      sections: its config sections. Their fields are keyword arguments of
        `make_rewarder`, and of `make_update_step` where there is one, so no two
        sections may have a field of the same name.
      make_rewarder: name of a function of its file: (AgentSpec, **fields) -> Rewarder.
      make_update_step: name of a function of its file that replaces the learner's own
        step: (Learner, **fields) -> UpdateStep; None for the learner's.
      uses_demonstrations: whether it imitates anything.
      sees_actions: whether it reads the expert's actions, or the field that decides.
      plays: whether the agent acts in the environment; a method that does not learns
        from demonstrations alone, and each update counts as the frames that other
        methods play per update.
      total_updates: length of a run of a method that does not play.
      needs_pixels: whether it cannot learn from state vectors.
      metrics: columns of train.csv beside those of the learner, such as "own/error".
      variations: fields of it that make ablations.
    """

    name: str
    label: str
    about: str
    colour: str = "#5b5b5b"
    rank: int = 100
    sections: Mapping[str, Mapping[str, Field]] = {}
    make_rewarder: str = "make_rewarder"
    make_update_step: str | None = None
    uses_demonstrations: bool = True
    sees_actions: bool | str = False
    plays: bool = True
    total_updates: int = 0
    needs_pixels: bool = False
    metrics: tuple[str, ...] = ()
    variations: tuple[Variation, ...] = ()


def problems(method: Method) -> Iterator[str]:
    """Yields each rule that the declaration breaks."""
    yield from _plain_problems(method)
    if not isinstance(method.sections, Mapping):
        yield f"has sections={method.sections!r}; give a dict of dicts of Field"
        return
    yield from _section_problems(method.sections)
    own = {
        f"{section}.{name}": field
        for section, fields in method.sections.items()
        if isinstance(fields, Mapping)
        for name, field in fields.items()
    }
    sees = method.sees_actions
    if isinstance(sees, str) and sees not in own:
        yield f"has sees_actions={sees!r}, which is none of its fields"
    yield from _metric_problems(method.metrics)
    yield from _variation_problems(method.variations, own)


def field_problems(name: str, field: Field, value: Any) -> Iterator[Fault]:
    """Yields why a field cannot have a value: its type, its choices or its range."""
    if fault := type_problem(name, field, value):
        yield fault
    elif field.choices:
        if value not in field.choices:
            yield unknown_name(name, value, field.choices)
    elif field.low is not None or field.high is not None:
        low = -math.inf if field.low is None else field.low
        high = math.inf if field.high is None else field.high
        inside = low <= value <= high  # False for NaN
        if not inside or (field.positive and value == low):
            interval = f"{'(' if field.positive else '['}{low}, {high}]"
            yield Fault(name, f"must lie in {interval}", field.about, value)


def type_problem(name: str, field: Field, value: Any) -> Fault | None:
    """Returns why a value cannot stand where a field's default does."""
    kind = type(field.default)
    if kind is float:
        fits = isinstance(value, int | float) and not isinstance(value, bool)
    else:
        fits = isinstance(value, list if kind is tuple else kind) or type(value) is kind
    return None if fits else Fault(name, f"must be {KINDS[kind]}", field.about, value)


def _plain_problems(method: Method) -> Iterator[str]:
    for name in ("name", "label", "about"):
        value = getattr(method, name)
        if not isinstance(value, str) or (not value and name != "about"):
            yield f"has {name}={value!r}; give a text"
    if not isinstance(method.rank, int | float) or method.rank != method.rank:
        yield f"has rank={method.rank!r}; give a number"
    colour = method.colour
    if not isinstance(colour, str) or not re.fullmatch(r"#[0-9a-fA-F]{6}", colour):
        yield f"has colour={colour!r}; write #rrggbb"


def _variation_problems(variations: Any, own: Mapping[str, Any]) -> Iterator[str]:
    if not isinstance(variations, tuple | list) or not all(
        isinstance(each, Variation) for each in variations
    ):
        yield f"has variations={variations!r}; give a tuple of Variation"
        return
    for field, plain, words in variations:
        declared = own.get(field)
        if not isinstance(declared, Field):
            yield f"has a variation of {field!r}, which is none of its fields"
            continue
        try:
            shown = words.format("\0")
        except (AttributeError, LookupError, ValueError):
            yield f"has a variation of {field} called {words!r}; write {{}} for a value"
            continue
        is_one = type(plain) is bool or len(declared.choices) == 2
        if not is_one and "\0" not in shown:
            yield (
                f"has a variation of {field} called {words!r}, which would name "
                "different values alike; write {} for the value"
            )


def _section_problems(sections: Any) -> Iterator[str]:
    owners: dict[str, str] = {}
    for section, fields in sections.items():
        if not isinstance(fields, Mapping) or not all(
            isinstance(field, Field) for field in fields.values()
        ):
            yield f"has sections[{section!r}]={fields!r}; give a dict of Field"
            continue
        for name, field in fields.items():
            if not (section.isidentifier() and name.isidentifier()):
                yield f"has {section}.{name}; use names as Python's variables have them"
            if name in owners:
                yield (
                    f"has {name!r} in both {owners[name]!r} and {section!r}, which "
                    "become one keyword; rename one"
                )
            owners[name] = section
            yield from _own_problems(f"{section}.{name}", field)


def _own_problems(name: str, field: Field) -> Iterator[str]:
    kind, choices = type(field.default), field.choices
    has_range = (field.low, field.high, field.at_most) != (None, None, "")
    if kind not in KINDS:
        way_out = "give True or False, a number, text or a tuple"
        yield f"has {name} with the default {field.default!r}; {way_out}"
    elif not _are_texts(choices):
        yield f"has {name} with choices={choices!r}; give a tuple of names"
    elif not isinstance(field.at_most, str):
        yield f"has {name} with at_most={field.at_most!r}; give a field's name"
    elif has_range and kind not in (int, float):
        yield f"has {name} with a range, which only numbers have"
    else:
        for fault in field_problems(name, field, field.default):
            yield f"has a default that its own rule forbids: {fault}"


def _are_texts(values: Any) -> bool:
    return isinstance(values, tuple | list) and all(isinstance(v, str) for v in values)


def _metric_problems(names: Any) -> Iterator[str]:
    if not _are_texts(names):
        yield f"has metrics={names!r}; give a tuple of names"
        return
    for name in dict.fromkeys(names):
        if names.count(name) > 1:
            yield f"has the metric {name!r} twice"
        if "/" not in name or name.startswith(_LEARNER_GROUPS):
            yield (
                f"has a metric {name!r}; write GROUP/NAME, with a group other than the "
                f"learner's ({', '.join(each[:-1] for each in _LEARNER_GROUPS)})"
            )
