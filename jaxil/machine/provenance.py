"""The machine and its software, for a run's config.json."""

import platform
from typing import Any

from jaxil.machine import devices

_PACKAGES = ["jaxil", "jax", "jaxlib", "flax", "optax", "mujoco", "dm-control", "numpy"]


def describe(gl_name: str, *, native: bool) -> dict[str, Any]:
    """Returns versions, device, convolutions ("native" for those in C) and renderer.

    jaxil itself has no version where it runs from a source tree that is not installed.
    """
    return {
        "versions": {
            "python": platform.python_version(),
            **{n: devices.version(n) or devices.NOT_INSTALLED for n in _PACKAGES},
        },
        "device": devices.device_name(),
        "convolutions": "native" if native else "xla",
        "renderer": gl_name,
    }
