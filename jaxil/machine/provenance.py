"""What a run stands on: versions, device, renderer, memory."""

import importlib.metadata
import platform as python_platform
from typing import Any

from jaxil import config as jaxil_config
from jaxil.config import Config
from jaxil.machine import startup

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


def describe(gl_name: str, *, native: bool) -> dict[str, Any]:
    """Returns what config.json says about the machine.

    Args:
      gl_name: the renderer's name for itself.
      native: whether the encoder's convolutions are our own.
    """
    return {
        "versions": {
            "python": python_platform.python_version(),
            **{name: importlib.metadata.version(name) for name in _PACKAGES},
        },
        "device": device_name(),
        "convolutions": "native" if native else "xla",
        "renderer": gl_name,
    }


def device_name() -> str:
    """Returns what jax computes on, such as "gpu: NVIDIA H100"."""
    import jax

    device = jax.devices()[0]
    return f"{device.platform}: {device.device_kind}"


def free_device_bytes() -> int | None:
    """Returns what jax may still take of its device's memory; None where unknown.

    Unknown for CPUs too, whose memory is the host's.
    """
    import jax

    statistics = jax.devices()[0].memory_stats() or {}
    if "bytes_limit" not in statistics:
        return None
    return statistics["bytes_limit"] - statistics.get("bytes_in_use", 0)


def host_memory_bytes(config: Config) -> int:
    """Returns what the replay takes of the host's memory, its copy counted on CPUs."""
    copied = jaxil_config.device_memory_bytes(config)
    on_host = copied > 0 and device_name().startswith("cpu")
    return jaxil_config.memory_bytes(config) + (copied if on_host else 0)


def memory_sentence(config: Config) -> str:
    """Says what the replay will take, before it is allocated."""
    if config.observation != "pixels":
        return "replay of state vectors: small"
    needed, stored = host_memory_bytes(config), jaxil_config.memory_bytes(config)
    text = (
        f"replay: {config.replay_size_steps} steps of {config.image_size}x"
        f"{config.image_size} pixels take {stored / 1e9:.2f} GB when full"
    )
    copied = jaxil_config.device_memory_bytes(config)
    if copied:
        text += f", its frames on {device_name()} another {copied / 1e9:.2f} GB"
    free = startup.available_memory_bytes()
    if free is not None and needed + _BESIDE_THE_REPLAY > free:
        text += (
            f"; WARNING: {free / 1e9:.1f} GB are free: lower replay_size_steps or "
            "image_size"
        )
    return text
