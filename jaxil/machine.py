"""What a run stands on: versions, device, renderer, memory."""

import importlib.metadata
import platform as python_platform
from typing import Any

from jaxil import config as jaxil_config
from jaxil import platform
from jaxil.config import Config

_PACKAGES = (
    "jaxil",
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "ott-jax",
    "mujoco",
    "dm-control",
    "numpy",
)
# Importing packages, compiled programs, batches and the learner itself.
_BESIDE_THE_REPLAY = 1.5e9


def describe(gl_name: str) -> dict[str, Any]:
    """Returns what config.json says about the machine.

    Args:
      gl_name: the renderer's name for itself.
    """
    import jax

    device = jax.devices()[0]
    return {
        "versions": {
            "python": python_platform.python_version(),
            **{name: importlib.metadata.version(name) for name in _PACKAGES},
        },
        "device": f"{device.platform}: {device.device_kind}",
        "renderer": gl_name,
    }


def memory_sentence(config: Config) -> str:
    """Says what the replay will take, before it is allocated."""
    if config.observation != "pixels":
        return "replay of state vectors: small"
    needed = jaxil_config.memory_bytes(config)
    text = (
        f"replay: {config.replay_size_steps} steps of {config.image_size}x"
        f"{config.image_size} pixels take {needed / 1e9:.2f} GB when full"
    )
    free = platform.available_memory_bytes()
    if free is not None and needed + _BESIDE_THE_REPLAY > free:
        text += (
            f"; WARNING: {free / 1e9:.1f} GB are free: lower replay_size_steps or "
            "image_size"
        )
    return text
