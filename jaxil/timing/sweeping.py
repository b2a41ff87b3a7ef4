"""One config field at several values: how cost grows with it."""

from typing import Any, NamedTuple

from jaxil import config as jaxil_config
from jaxil.config import Config
from jaxil.errors import UsageError
from jaxil.training import assembly

_EXAMPLE = "such as --sweep=batch_size:64,128,256"


class Sweep(NamedTuple):
    """What varies.

    Attributes:
      field: dotted name in the config.
      configs: by value, in the order that was asked for; each one checked.
    """

    field: str
    configs: dict[int | float, Config]


def parse(text: str, config: Config) -> Sweep:
    """Reads FIELD:VALUE,VALUE,...

    Args:
      text: of the flag.
      config: the other fields.

    Raises:
      UsageError: names all faults, those of the configs that would come of it too.
    """
    field, _, listed = text.partition(":")
    numbers = _number_fields(config)
    if field not in numbers:
        fault = jaxil_config.unknown_name("--sweep", field, tuple(numbers))
        raise UsageError(f"{fault} (a field that is a number, {_EXAMPLE})")
    faults, configs = [], {}
    for word in listed.split(","):
        try:
            value = type(numbers[field])(word)
        except ValueError:
            kind = "a whole number" if isinstance(numbers[field], int) else "a number"
            faults.append(f"--sweep={text!r}: {word!r} is not {kind}; write {_EXAMPLE}")
            continue
        configs[value] = _with(config, field, value)
        faults += [
            fault for fault in assembly.problems(configs[value]) if fault not in faults
        ]
    if faults:
        raise UsageError(faults)
    return Sweep(field, configs)


def _with(config: Config, field: str, value: int | float) -> Config:
    changed = config.copy_and_resolve_references()
    *parents, name = field.split(".")
    holder = changed
    for parent in parents:
        holder = holder[parent]
    holder[name] = value
    return changed


def _number_fields(config: Config) -> dict[str, int | float]:
    fields: dict[str, Any] = {}
    for name, value in config.items():
        if hasattr(value, "items"):
            fields |= {f"{name}.{inner}": each for inner, each in value.items()}
        else:
            fields[name] = value
    return {
        name: value
        for name, value in fields.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
