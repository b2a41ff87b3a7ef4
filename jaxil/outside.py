"""Code of the user's own, by `package.module:name`.

A run's folder may come from somebody else, so what it names is imported only if the
user has named it too: on this process's command line, or in their own config.
"""

import importlib
import re
import sys
from typing import Any

from jaxil.errors import Fault, UsageError

_confirmed: set[str] = set()


def confirm(reference: str) -> None:
    """Lets files name this code; for programs, which have no command line of ours."""
    _confirmed.add(reference)


def load(reference: str, subject: str) -> Any:
    """Imports a module and returns what it calls by that name.

    Args:
      reference: "package.module:name", from the user.
      subject: the field or flag that holds it, for messages.

    Raises:
      UsageError: there is no such module or name, or importing it fails.
    """
    module, _, name = reference.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except Exception as error:  # whatever the user's file raises
        raise UsageError(
            Fault(
                subject,
                f"cannot be loaded ({type(error).__name__}: {error})",
                "write package.module:name, and add the package's folder to PYTHONPATH",
                reference,
            )
        ) from error


def require_named(reference: str, subject: str, where: object) -> None:
    """Refuses what a file names and the command line does not.

    Args:
      reference: "package.module:name", as read from the file.
      subject: the field that holds it.
      where: the file.

    Raises:
      UsageError: it is not one of this command line's values.
    """
    given = re.split("[=,\0]", "\0".join(sys.argv[1:]))
    if reference not in _confirmed.union(given):
        raise UsageError(
            Fault(
                subject,
                f"stands in {where}, and is code that this command line does not name",
                f"if you trust it, name it yourself with --{subject}={reference} "
                "(Python: jaxil.outside.confirm)",
                reference,
            )
        )
