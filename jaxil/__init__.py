"""Imitation learning from pixel observations, in JAX.

    policy = jaxil.load_policy("runs/quickstart")
    environment = policy.make_environment()  # or jaxil.make_environment(task, seed=0)
    demonstrations = jaxil.load_demonstrations(task="cartpole_swingup")

Each name is imported on first use, so that `import jaxil` is fast. Before that, OpenGL
and jax are set up as the commands do it.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxil.demonstrations.loading import load as load_demonstrations
    from jaxil.environments.tasks import make_environment
    from jaxil.errors import UsageError
    from jaxil.outside import trust
    from jaxil.training.trained import load_policy

__all__ = [
    "UsageError",
    "load_demonstrations",
    "load_policy",
    "make_environment",
    "trust",
]

_PLACES = {
    "UsageError": ("jaxil.errors", "UsageError"),
    "load_demonstrations": ("jaxil.demonstrations.loading", "load"),
    "load_policy": ("jaxil.training.trained", "load_policy"),
    "make_environment": ("jaxil.environments.tasks", "make_environment"),
    "trust": ("jaxil.outside", "trust"),
}
_PLAIN = ("UsageError", "trust")  # need neither OpenGL nor jax


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name not in _PLAIN:
        from jaxil.machine import startup

        startup.prepare()
    module, attribute = _PLACES[name]
    globals()[name] = getattr(importlib.import_module(module), attribute)
    return globals()[name]
