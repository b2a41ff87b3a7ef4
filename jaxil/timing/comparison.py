"""Two results side by side: which of them can be compared, and what differs."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any

from jaxil.command import UsageError
from jaxil.files.settings import as_stored, flat
from jaxil.timing.tables import ROWS

# Whatever jaxil wrote the file, old or new, it has these.
_ALWAYS = {"update_ms": int | float, "device": str, "config": dict}
_CIRCUMSTANCES = ("device", "num_devices", "processor", "usable_cores", "machine")


def read(path: str) -> dict[str, Any]:
    """Returns the results in a file of `--json`.

    Raises:
      UsageError: it is none.
    """
    hint = "give a file that `python -m jaxil.benchmark --json=FILE` wrote"
    try:
        results = json.loads(pathlib.Path(path).read_text())
    except OSError as error:
        raise UsageError(
            f"--compare={path} can't be read ({error.strerror}): {hint}"
        ) from error
    except ValueError as error:
        raise UsageError(f"--compare={path} is not JSON ({error}): {hint}") from error
    if isinstance(results, list):
        raise UsageError(f"--compare={path} is a sweep's: {hint}, without --sweep")
    fields = results if isinstance(results, dict) else {}
    missing = [n for n, kind in _ALWAYS.items() if not isinstance(fields.get(n), kind)]
    if missing:
        raise UsageError(
            f"--compare={path} holds no results (it lacks {', '.join(missing)}): {hint}"
        )
    return results


def pairs(
    old: Mapping[str, Any], new: Mapping[str, Any]
) -> dict[str, tuple[float, float]]:
    """Returns the old and the new number of each name that both have."""
    names = [name for rows in ROWS.values() for name in rows]
    return {
        name: (float(old[name]), float(new[name]))
        for name in names
        if _is_number(old.get(name)) and _is_number(new.get(name))
    }


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names what else differs: device, machine, fields of the config."""
    lines = [
        f"{name}: {old[name]!r} then, {new.get(name)!r} now"
        for name in _CIRCUMSTANCES
        if name in old and old[name] != new.get(name)
    ]
    before, now = (flat(as_stored(each["config"])) for each in (old, new))
    missing = object()
    for field in sorted(before.keys() | now.keys()):
        values = before.get(field, missing), now.get(field, missing)
        if values[0] == values[1]:
            continue
        then, here = ("absent" if v is missing else repr(v) for v in values)
        lines.append(f"config.{field}: {then} then, {here} now")
    return lines


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
