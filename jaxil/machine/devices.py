"""The processor, the accelerator and its memory.

Only functions that need jax import it: start-up calls the others before that.
"""

import glob
import importlib.metadata
import importlib.util
import os
import pathlib
import platform
from typing import Any

from jaxil.errors import Fault, UsageError

NOT_INSTALLED = "not installed"


def has_cuda_device() -> bool:
    """Returns whether CUDA can see an NVIDIA device."""
    if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return False
    return bool(glob.glob("/dev/nvidia[0-9]*")) or os.path.exists("/dev/dxg")


def uses_cpu() -> bool:
    """Returns whether jax will compute on the CPU, without importing jax."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms:
        return platforms.split(",")[0].strip() == "cpu"
    has_plugin = bool(importlib.metadata.entry_points(group="jax_plugins"))
    on_gpu = has_plugin and (has_cuda_device() or os.path.exists("/dev/kfd"))
    on_tpu = importlib.util.find_spec("libtpu") is not None and bool(
        glob.glob("/dev/accel[0-9]*") or glob.glob("/dev/vfio/[0-9]*")
    )
    return not (on_gpu or on_tpu)


def version(package: str) -> str | None:
    """Returns the installed version of a package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def instruction_set() -> str:
    """Returns the CPU's model and features.

    Home folders are shared between machines, and code compiled for one processor may
    contain instructions that another lacks.
    """
    lines = {s for s in _cpuinfo() if s.startswith(("model name", "flags"))}
    return "\n".join(sorted(lines))


def device_name() -> str:
    """Returns what jax computes on, such as "gpu: NVIDIA H100".

    Raises:
      UsageError: JAX_PLATFORMS names what this machine lacks.
    """
    import jax

    try:
        device = jax.devices()[0]
    except (RuntimeError, AssertionError) as error:  # the latter without a reason
        platforms = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error).splitlines()[0] if str(error) else "no such device"
        way_out = "unset it; `python -m jaxil.doctor` says what to install"
        rule = f"is not available here: {reason}"
        raise UsageError(Fault("JAX_PLATFORMS", rule, way_out, platforms)) from error
    return f"{device.platform}: {device.device_kind}"


def free_bytes() -> int | None:
    """Returns what jax may still allocate on its device; None for CPUs."""
    statistics = _memory_statistics()
    if "bytes_limit" not in statistics:
        return None
    return statistics["bytes_limit"] - statistics.get("bytes_in_use", 0)


def peak_bytes() -> int | None:
    """Returns the peak of jax's allocations on its device; None if unknown."""
    return _memory_statistics().get("peak_bytes_in_use")


def describe() -> dict[str, Any]:
    """Returns a description of the device and machine."""
    import jax

    processors = (s.split(":")[1].strip() for s in _cpuinfo() if "model name" in s)
    return {
        "device": device_name(),
        "num_devices": jax.device_count(),
        "machine": platform.platform(),
        "processor": next(processors, platform.processor()),
        "cores": os.cpu_count(),
        "usable_cores": len(os.sched_getaffinity(0)),
    }


def _memory_statistics() -> dict[str, int]:
    import jax

    return jax.devices()[0].memory_stats() or {}


def _cpuinfo() -> list[str]:
    try:
        return pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []
