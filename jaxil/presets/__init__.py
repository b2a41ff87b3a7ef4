"""Presets by name: `--config=NAME[:ARGUMENT]`.

`METHOD:TASK` gives the paper's settings for any method, a known one's name or
`package.module:METHOD`; each module of this folder is one more preset. The repository's
`configs/` hold the same presets as files.
"""

import importlib
import pkgutil

from jaxil import config as jaxil_config
from jaxil import methods, outside
from jaxil.config import Config
from jaxil.errors import UsageError, unknown_name

_DEFAULT_TASK = "walker_walk"
_OWN = tuple(module.name for module in pkgutil.iter_modules(__path__))


def names() -> tuple[str, ...]:
    """Returns the names of all presets."""
    return (*_OWN, *methods.known())


def get_config(name: str, argument: str | None = None) -> Config:
    """Returns the settings of a preset, or of a method in a module of one's own.

    The argument is METHOD,TASK of `tiny`, METHOD or METHOD:TASK of a module, TASK of
    the others; None stands for the preset's own default.

    Raises:
      UsageError: there is no such preset, or the argument is wrong.
    """
    if name in _OWN:
        module = importlib.import_module(f"{__name__}.{name}")
        return module.get_config(*([] if argument is None else [argument]))
    if name in methods.known():
        return jaxil_config.default_config(name, argument or _DEFAULT_TASK)
    if argument and outside.spec_of(name) is not None:
        method, _, task = argument.partition(":")
        return jaxil_config.default_config(f"{name}:{method}", task or _DEFAULT_TASK)
    raise UsageError(unknown_name("--config", name, names()))
