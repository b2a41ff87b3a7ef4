"""What a run's config.json says about the machine and its software."""

import importlib.metadata
import platform
from typing import Any

from jaxil.machine import devices

_PACKAGES = (
    *("jaxil", "jax", "jaxlib", "flax", "optax", "ott-jax"),
    *("mujoco", "dm-control", "numpy"),
)


def describe(gl_name: str, *, native: bool) -> dict[str, Any]:
    """Returns versions, device, form of the convolutions and renderer.

    Args:
      gl_name: the renderer's name for itself.
      native: whether the encoder in C is used.
    """
    return {
        "versions": {
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in _PACKAGES},
        },
        "device": devices.device_name(),
        "convolutions": "native" if native else "xla",
        "renderer": gl_name,
    }
