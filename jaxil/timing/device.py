"""What the numbers were measured on, and how fast it multiplies matrices."""

import functools
import os
import pathlib
import platform as python_platform
from typing import Any

import jax
import jax.numpy as jnp

from jaxil.timing import flops
from jaxil.timing.clock import timed

# Sides of the products that are tried, until one takes this long: small ones leave
# large devices idle, large ones take small devices minutes.
_SIDES = (512, 1024, 2048, 4096, 8192)
_LONG_SECONDS = 0.05
_PRODUCTS = 5  # of each size


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
    multiply, best = jax.jit(jnp.matmul), 0.0
    for side in _SIDES:
        matrix = jax.random.normal(jax.random.key(0), (side, side), jnp.float32)
        seconds = timed(functools.partial(multiply, matrix, matrix), _PRODUCTS).low
        best = max(best, flops.matrix_product(side) / seconds)
        if seconds > _LONG_SECONDS:
            break
    return best


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
