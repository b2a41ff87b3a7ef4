"""Measures the parts of a run one by one, then the whole loop."""

import contextlib
import functools
import pathlib
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.config import Config
from jaxil.machine import devices, memory
from jaxil.timing import start
from jaxil.timing.bench import Bench

_TURNS = 4  # the loop's two forms alternate
_SHORT_PARTS = ("physics_ms", "render_ms", "act_ms")  # get ten times the repeats
# Sizes of matrix products, increased until one takes `_LONG_SECONDS`: small ones do not
# fill large devices, large ones take minutes on small devices.
_PRODUCT_SIZES = (512, 1024, 2048, 4096, 8192)
_LONG_SECONDS = 0.05


def measure(
    config: Config,
    *,
    repeats: int,
    steps: int,
    environment: Mapping[str, str] | None = None,
    full: bool = False,
) -> dict[str, Any]:
    """Measures a run of a config.

    Args:
      config: checked.
      repeats: timings of each part, of which the median is reported.
      steps: agent steps to time for each of the loop's two forms.
      environment: variables of the process whose start is timed; None skips this and
        compilation without a cache.
      full: whether to fill the replay before memory is measured.

    Returns:
      All rows of `summary.ROWS`, None if not applicable; `ranges`, lowest and highest
      by row; the machine; the config.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.closing(Bench(config, pathlib.Path(folder))) as bench,
    ):
        results: dict[str, Any] = {"ranges": {}}
        for name, (function, num_calls) in bench.parts().items():
            if function is None:
                results[name] = None
                continue
            times = 10 * repeats if name in _SHORT_PARTS else repeats
            timings = [1e3 * each / num_calls for each in timed(function, times)]
            # Not the mean: other processes only add time.
            results[name] = float(np.median(timings))
            results["ranges"][name] = [min(timings), max(timings)]
        results |= _time_loop(bench, steps)
        if full:
            bench.fill_replay()
        results |= _memory(bench) | _arithmetic(bench, results["update_ms"])
        results["compile_seconds"] = bench.first_update_seconds
        results |= dict.fromkeys(("start_seconds", "compile_cold_seconds"))
        if environment is not None:
            results["start_seconds"] = start.first_step_seconds(config, environment)
            results["compile_cold_seconds"] = start.compile_seconds(bench.lower)
        frames = len(bench.episode.actions) * config.action_repeat
    loop = frames / results["frames_per_second"]
    reward = results["reward_ms"] / 1e3
    results["reward_percent"] = 100 * reward / (loop + reward)
    results["run_hours"] = config.total_frames / frames * (loop + reward) / 3600
    return {
        **results,
        **devices.describe(),
        "repeats": repeats,
        "steps": steps,
        "full": full,
        "config": config.to_dict(),
    }


def _time_loop(bench: Bench, steps: int) -> dict[str, float]:
    """Alternates between the loop and a form whose environments wait for updates."""
    totals = {False: [0.0] * 3, True: [0.0] * 3}
    for turn in range(_TURNS):
        share = steps * (turn + 1) // _TURNS - steps * turn // _TURNS
        for waits in (False, True) if turn % 2 else (True, False):
            found = bench.loop(share, waits=waits)
            totals[waits] = [a + b for a, b in zip(totals[waits], found)]
    frames, seconds, working = totals[False]
    return {
        "frames_per_second": frames / seconds,
        "frames_per_second_in_turn": totals[True][0] / totals[True][1],
        "loop_overhead_percent": 100.0 * (seconds / working - 1.0),
    }


def _memory(bench: Bench) -> dict[str, float | None]:
    program = bench.lower().compile().memory_analysis()
    on_device = devices.peak_bytes()
    return {
        "learner_state_mb": _num_bytes(bench.run.state) / 1e6,
        "batch_mb": _num_bytes(bench.batches) / 1e6,
        "update_temp_mb": getattr(program, "temp_size_in_bytes", 0) / 1e6,
        "replay_gb": bench.run.replay.frames.nbytes / 1e9,
        "peak_memory_gb": memory.peak_bytes() / 1e9,
        "peak_device_memory_gb": None if on_device is None else on_device / 1e9,
    }


def _num_bytes(tree: Any) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


def _arithmetic(bench: Bench, update_ms: float) -> dict[str, float]:
    # XLA cannot count the operations of the encoder in C, so use its own convolutions.
    cost = bench.lower(convolutions="xla").cost_analysis()
    peak = _product_flops_per_second()
    return {
        "update_gflop": cost["flops"] / 1e9,
        "matrix_product_gflops": peak / 1e9,
        "utilisation_percent": 1e5 * cost["flops"] / update_ms / peak,
    }


def _product_flops_per_second() -> float:
    """Returns the best rate of several matrix products.

    They use jax's default precision, like the update: TF32 on newer NVIDIA devices.
    """
    multiply, best = jax.jit(jnp.matmul), 0.0
    for size in _PRODUCT_SIZES:
        matrix = jax.random.normal(jax.random.key(0), (size, size), jnp.float32)
        seconds = min(timed(functools.partial(multiply, matrix, matrix), 5))
        best = max(best, 2 * size**3 / seconds)
        if seconds > _LONG_SECONDS:
            break
    return best


def timed(function: Callable[[], Any], repeats: int) -> list[float]:
    """Returns the seconds of each call, after one that may compile."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - begin)
    return seconds
