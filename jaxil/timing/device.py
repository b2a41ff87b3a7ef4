"""What the numbers were measured on, and how fast it multiplies matrices."""

import os
import pathlib
import platform as python_platform
from typing import Any

import jax
import jax.numpy as jnp

from jaxil.timing import flops
from jaxil.timing.clock import timed

# Large enough that memory traffic counts for nothing: 17 and 1100 GFLOP.
_SIZE_ON_CPU, _SIZE_ON_ACCELERATOR = 2048, 8192
_PRODUCTS = 7


def describe() -> dict[str, Any]:
    """Names the device, the processor and what of it this process may use."""
    device = jax.devices()[0]
    return {
        "device": f"{device.platform}: {device.device_kind}",
        "num_devices": jax.device_count(),
        "machine": python_platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "usable_cores": len(os.sched_getaffinity(0)),
        "threads": len(list(pathlib.Path("/proc/self/task").iterdir())),
    }


def peak_flops_per_second() -> float:
    """Returns the best of several float32 matrix products, in operations a second.

    At jax's default precision, which is that of the update too: on newer NVIDIA
    devices it is TF32.
    """
    on_cpu = jax.default_backend() == "cpu"
    size = _SIZE_ON_CPU if on_cpu else _SIZE_ON_ACCELERATOR
    matrix = jax.random.normal(jax.random.key(0), (size, size), jnp.float32)
    multiply = jax.jit(jnp.matmul)
    return (
        flops.matrix_product(size)
        / timed(lambda: multiply(matrix, matrix), _PRODUCTS).low
    )


def peak_device_bytes() -> int | None:
    """Returns the most that the accelerator's memory held; None where jax can't say."""
    statistics = jax.devices()[0].memory_stats() or {}
    return statistics.get("peak_bytes_in_use")


def _processor() -> str:
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    return next(names, python_platform.processor())
