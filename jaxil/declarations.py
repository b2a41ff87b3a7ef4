"""What is wrong with a method's declaration, all of it at once."""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from jaxil.errors import Fault, UsageError
from jaxil.methods import Field, Method

_TYPES = (bool, int, float, str, tuple)  # that flags can be read as
_LEARNERS = ("critic/", "actor/", "batch/", "replay/")  # columns of train.csv


def checked(method: Method, taken: Collection[str]) -> Method:
    """Returns the method, if its sections, fields and metrics can be used.

    Args:
      method: as declared.
      taken: names of the fields and sections that every config has.

    Raises:
      UsageError: names every fault.
    """
    faults = [*_section_problems(method.sections, taken), *_metric_problems(method)]
    if faults:
        raise UsageError([Fault("method", f, value=method.name) for f in faults])
    return method


def _section_problems(sections: Any, taken: Collection[str]) -> Iterator[str]:
    if not _is_mapping_of(sections, Mapping):
        yield f"has sections={sections!r}; give a dict of dicts of Field"
        return
    owners: dict[str, str] = {}
    for section, fields in sections.items():
        if section in taken:
            yield f"has a section {section!r}, which every config has; rename it"
        if not _is_mapping_of(fields, Field):
            yield f"has sections[{section!r}]={fields!r}; give a dict of Field"
            continue
        for name, field in fields.items():
            if name in owners:
                yield (
                    f"has {name!r} in both {owners[name]!r} and {section!r}, which "
                    "become one keyword; rename one"
                )
            owners[name] = section
            if not isinstance(field.default, _TYPES):
                yield (
                    f"has {section}.{name} with the default {field.default!r}; flags "
                    "can be True or False, numbers, text or tuples"
                )


def _metric_problems(method: Method) -> Iterator[str]:
    names = method.metrics
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        yield f"has metrics={names!r}; give a tuple of names"
        return
    for name in names:
        if "/" not in name or name.startswith(_LEARNERS):
            yield (
                f"has a metric {name!r}; write GROUP/NAME, with a group other than the "
                f"learner's ({', '.join(each[:-1] for each in _LEARNERS)})"
            )


def _is_mapping_of(found: Any, kind: Any) -> bool:
    return isinstance(found, Mapping) and all(
        isinstance(value, kind) for value in found.values()
    )
