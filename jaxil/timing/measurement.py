"""All parts of a run, timed and weighed one after the other, then the loop."""

import contextlib
import pathlib
import resource
import sys
import tempfile
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jaxil.config import Config
from jaxil.replay import replay
from jaxil.timing import arithmetic, compiling, device, start
from jaxil.timing.bench import Bench, make_bench
from jaxil.timing.clock import timed
from jaxil.training import assembly

_TURNS = 4  # of the loop's two forms
_UPDATE_PARTS = ("encoder", "critic", "actor", "rewarder", "optimiser")


def measure(
    config: Config,
    *,
    repeats: int,
    steps: int,
    environment: Mapping[str, str] | None = None,
    full: bool = False,
) -> dict[str, Any]:
    """Times the parts of a run.

    Args:
      config: checked.
      repeats: timings of each part, of which the median counts: ten times as many of
        the short ones, fewer of the longest.
      steps: decisions that are timed of each of the loop's two forms.
      environment: variables of the process in which starting is timed; None leaves
        that out, and compiling without a cache.
      full: whether the replay is filled before memory is weighed.

    Returns:
      What `tables.ROWS` names, None where it does not apply; `ranges`, lowest and
      highest by name; what it was measured on; the config.
    """
    demonstrations = assembly.load_demonstrations(config)
    with tempfile.TemporaryDirectory() as folder:
        bench = make_bench(config, pathlib.Path(folder), demonstrations, say=_say)
        with contextlib.closing(bench.run):
            parts, ranges = _time_parts(bench, repeats)
            results = {**parts, **_time_loop(bench, steps)}
            if full:
                bench.fill_replay()
            results |= _memory(bench)
        results |= arithmetic.count(bench, results["update_ms"])
        results |= _whole_run(config, results, len(bench.episode.actions))
        results |= _before_the_first_step(config, bench, environment)
        bench.run.outputs.close()
    return {
        **results,
        "ranges": ranges,
        **device.describe(),
        "repeats": repeats,
        "steps": steps,
        "full": full,
        "config": config.to_dict(),
    }


def _time_parts(
    bench: Bench, repeats: int
) -> tuple[dict[str, Any], dict[str, tuple[float, float]]]:
    """Returns medians and ranges in milliseconds, by the names of the table."""
    run, rng = bench.run, np.random.default_rng(0)
    draw = run.environment.renderer.render
    if run.config.observation == "state":
        draw = run.environment.frame
    observation = run.environment.reset(episode=0).observation
    batches = bench.dispatched()
    on_device, together = jax.device_put(batches), run.config.updates_per_dispatch
    often, few, rarely = 10 * repeats, max(repeats // 2, 1), max(repeats // 5, 1)
    functions: dict[str, tuple[Callable[[], Any], int]] = {
        "physics_ms": (_physics_step(run.config), often),
        "render_ms": (draw, often),
        "act_ms": (lambda: run.act(observation), often),
        "insert_ms": (bench.add_episode, repeats),
        "sample_ms": (lambda: run.updates.draw(rng), repeats),
        "transfer_ms": (lambda: jax.device_put(batches), repeats),
        "update_ms": (lambda: bench.update(on_device), repeats),
        "reward_ms": (lambda: run.reward(bench.episode), few),
        "evaluation_ms": (bench.play_evaluation, rarely),
        "checkpoint_ms": (bench.save, few),
    }
    for name, function in bench.update_parts().items():
        functions[f"update_{name}_ms"] = (function, repeats)
    parts: dict[str, Any] = {f"update_{name}_ms": None for name in _UPDATE_PARTS}
    ranges = {}
    for name, (function, times) in functions.items():
        # Several updates go to the device together, but numbers are of one.
        factor = 1e3 / (together if name in ("update_ms", "transfer_ms") else 1)
        timing = timed(function, times)
        parts[name] = factor * timing.median
        ranges[name] = (factor * timing.low, factor * timing.high)
    parts["compile_seconds"] = bench.first_update_seconds
    return parts, ranges


def _physics_step(config: Config) -> Callable[[], Any]:
    # State vectors are read, nothing is drawn.
    environment = assembly.training_environment(_with(config, observation="state"))
    environment.reset(episode=0)
    action = np.zeros(environment.action_spec().shape)
    return lambda: environment.step(action)


def _with(config: Config, **changes: Any) -> Config:
    config = config.copy_and_resolve_references()
    with config.unlocked():
        config.update(changes)
    return config


def _time_loop(bench: Bench, steps: int) -> dict[str, float]:
    """Times the loop as it is, and with updates that are waited for, in turn."""
    run, stopwatch = bench.run, bench.run.stopwatch
    frames, seconds, working = [0, 0], [0.0, 0.0], [0.0, 0.0]
    for turn in range(_TURNS):
        share = steps * (turn + 1) // _TURNS - steps * turn // _TURNS
        for waits in (False, True) if turn % 2 else (True, False):
            first, before = run.frame, sum(stopwatch.seconds.values())
            seconds[waits] += bench.loop(share, waits=waits)
            working[waits] += sum(stopwatch.seconds.values()) - before
            frames[waits] += run.frame - first
    return {
        "frames_per_second": frames[False] / seconds[False],
        "frames_per_second_in_turn": frames[True] / seconds[True],
        "loop_overhead_percent": 100.0 * (seconds[False] / working[False] - 1.0),
    }


def _before_the_first_step(
    config: Config, bench: Bench, environment: Mapping[str, str] | None
) -> dict[str, float | None]:
    """Times what people wait for. Compiling anew forgets all that is compiled."""
    names = ("start_seconds", "compile_cold_seconds", "compile_warm_seconds")
    if environment is None:
        return dict.fromkeys(names)
    # A single environment steps in the process that is watched.
    config = _with(config, num_environments=1)
    started = start.seconds_to_first_step(config, environment, _say)
    return dict(zip(names, (started, *compiling.cold_and_warm(bench.lower_update))))


def _memory(bench: Bench) -> dict[str, float | None]:
    run, frames, actions = bench.run, bench.episode.frames, bench.episode.actions
    full = replay.memory_bytes(
        capacity_steps=run.config.replay_size_steps,
        episode_steps=len(actions),
        observation_shape=frames.shape[1:],
        observation_dtype=frames.dtype,
        action_dim=actions.shape[1],
    )
    on_device = device.peak_device_bytes()
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "parameters_mb": _megabytes(run.state.params),
        "learner_state_mb": _megabytes(run.state),
        "batch_mb": _megabytes(bench.batches),
        "experts_mb": _megabytes(run.experts),
        "replay_gb": full / 1e9,
        "peak_memory_gb": peak / 1e9,
        "peak_device_memory_gb": None if on_device is None else on_device / 1e9,
    }


def _whole_run(
    config: Config, results: Mapping[str, Any], episode_steps: int
) -> dict[str, float]:
    """Adds up a whole run from its parts: milliseconds for each frame, then hours."""
    reward = results["reward_ms"] / (episode_steps * config.action_repeat)
    evaluation = results["evaluation_ms"] * config.num_eval_episodes
    evaluation /= config.eval_every_frames
    checkpoint = results["checkpoint_ms"] / config.checkpoint_every_frames
    loop = 1000.0 / results["frames_per_second"]
    per_frame = loop + reward + evaluation + checkpoint
    return {
        "reward_percent": 100.0 * reward / per_frame,
        "evaluation_percent": 100.0 * evaluation / per_frame,
        "run_frames_per_second": 1000.0 / per_frame,
        "run_hours": config.total_frames * per_frame / 3.6e6,
    }


def _megabytes(tree: Any) -> float:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) / 1e6


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
