"""The machine and its software, for a run's config.json."""

import importlib.metadata
import platform
from typing import Any

from jaxil.machine import devices

_PACKAGES = (
    *("jaxil", "jax", "jaxlib", "flax", "optax"),
    *("mujoco", "dm-control", "numpy"),
)


def describe(gl_name: str, *, native: bool) -> dict[str, Any]:
    """Returns versions, device, convolutions ("native" for those in C) and renderer."""
    return {
        "versions": {
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in _PACKAGES},
        },
        "device": devices.device_name(),
        "convolutions": "native" if native else "xla",
        "renderer": gl_name,
    }
