"""Code of the user's own, by `package.module:name`.

A run's folder may come from somebody else, and importing a module runs it. So what a
folder names is imported only if the user has named it in this process: in their own
config, or with `--trust`.
"""

import importlib
import importlib.machinery
import importlib.util
from collections.abc import Mapping
from typing import Any

from jaxil.errors import Fault, UsageError, printable, raised

_trusted: set[str] = set()


def load(reference: str, subject: str) -> Any:
    """Imports what a user's reference, "package.module:name", names.

    Messages call it `subject`, the field or flag that holds it.

    Raises:
      UsageError: there is no such module or name, or importing it fails.
    """
    module, _, name = reference.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:  # whatever the user's file raises
        rule = f"cannot be loaded: {raised(error)}"
        way_out = "add the package's folder to PYTHONPATH"
        way_out = f"write package.module:name, and {way_out}"
        raise UsageError(Fault(subject, rule, way_out, reference)) from error


def trust(reference: str) -> None:
    """Notes that the user has named this code, so files may name it too.

    Args:
      reference: of a method or task, as a run's config has it.
    """
    _trusted.add(reference)


def is_found(reference: str) -> bool:
    """Returns whether a reference names a module that Python finds, and a name."""
    module, colon, name = reference.removeprefix("gymnasium:").partition(":")
    return bool(colon and name) and spec_of(module) is not None


def spec_of(module: str) -> importlib.machinery.ModuleSpec | None:
    """Returns where Python would import a module from; None if it finds none."""
    try:
        return importlib.util.find_spec(module)
    except (Exception, SystemExit):  # it imports the packages around the module
        return None


def is_trusted(reference: str) -> bool:
    """Returns whether a file may name this code."""
    return reference in _trusted


def require_trusted(references: Mapping[str, str], where: object) -> None:
    """Refuses code that the file `where` names, by its field, and the user does not.

    Raises:
      UsageError: the user has not named all of it in this process.
    """
    faults = [
        Fault(
            subject,
            f"is code from outside that {where} names and you do not",
            f"if you trust it, add --trust={printable(reference)} (in Python: "
            "jaxil.trust)",
            printable(reference),
        )
        for subject, reference in references.items()
        if not is_trusted(reference)
    ]
    if faults:
        raise UsageError(faults)
