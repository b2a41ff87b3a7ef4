r"""Times the parts of a run on this machine, and the loop that joins them.

    python -m jaxil.benchmark --config=configs/pdac_walker.py --json=benchmark.json

Medians over repeats, after a warm-up; nothing is learned and nothing kept.
"""

import io
import json
import pathlib
import platform as python_platform
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from absl import flags

from jaxil import command

_ROWS = {
    "update_ms": "one update of the learner, its batch given",
    "sample_ms": "drawing one batch from the replay",
    "act_ms": "one exploring action",
    "physics_ms": "one agent step, without drawing",
    "render_ms": "drawing one frame",
    "reward_ms": "rewarding one episode at its end",
    "compile_seconds": "compiling the update, or reading it from the cache",
    "frames_per_second": "the whole loop, evaluation and checkpoints left out",
    "loop_overhead_percent": "what the loop adds to environment, acting and updating",
    "reward_percent": "share of rewarding in the run's time",
    "peak_memory_gb": "of this process",
}


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(argv, __doc__ or "", _define)
    from jaxil import platform

    print(platform.prepare(), file=sys.stderr, flush=True)
    from jaxil import experiment

    faults = experiment.problems(values.config)
    if faults:
        raise command.UsageError(command.listing(faults))
    results = measure(values.config, repeats=values.repeats, steps=values.steps)
    for name, meaning in _ROWS.items():
        print(f"{name:<24} {results[name]:>10.2f}  {meaning}")
    if values.json:
        from jaxil.host.metrics import write_atomically

        text = json.dumps(results, indent=2) + "\n"
        try:
            write_atomically(values.json, text.encode())
        except OSError as error:
            raise command.UsageError(
                f"--json={values.json} can't be written ({error.strerror}); name a "
                "file in a folder of yours"
            ) from error


def measure(config: Any, *, repeats: int, steps: int) -> dict[str, Any]:
    """Times the parts of a run.

    Args:
      config: checked.
      repeats: timings of each part, of which the median counts.
      steps: decisions of the loop that are timed.

    Returns:
      What `_ROWS` names, and the device, machine and config.
    """
    import jax

    from jaxil import train
    from jaxil.host.progress import ProgressLine

    config = config.copy_and_resolve_references()
    with config.unlocked():
        # The loop shall act and learn from its first decision on.
        config.exploration_steps = 0
        config.seed_frames = config.action_repeat
        config.total_frames = steps * config.action_repeat
        config.eval_every_frames = config.checkpoint_every_frames = 10**9
    with tempfile.TemporaryDirectory() as folder:
        from jaxil import experiment

        demonstrations = experiment.load_demonstrations(config)
        run = train.Run(config, pathlib.Path(folder), demonstrations, print)
        # A benchmark prints its table only.
        run.progress = ProgressLine(config.total_frames, stream=io.StringIO())
        episode = _random_episode(run, config)
        run.replay.add_episode(
            frames=episode.frames,
            actions=episode.actions,
            rewards=episode.task_rewards,
            discounts=episode.discounts,
        )
        observation = run.environment.reset(episode=0).observation
        start = time.perf_counter()
        _update(run)
        compile_seconds = time.perf_counter() - start
        batch_rng = np.random.default_rng(0)
        parts = {
            "update_ms": _median_ms(lambda: _update(run), repeats),
            "sample_ms": _median_ms(
                lambda: run.replay.sample(batch_rng, config.batch_size), repeats
            ),
            "act_ms": _median_ms(lambda: run.act(observation), 10 * repeats),
            "physics_ms": _physics_ms(config, 10 * repeats),
            "render_ms": _median_ms(run.environment.frame, 10 * repeats)
            if config.observation == "state"
            else _median_ms(run.environment.renderer.render, 10 * repeats),
            "reward_ms": _median_ms(lambda: run.reward(episode), max(repeats // 2, 1)),
        }
        parts["update_ms"] -= parts["sample_ms"]
        before = dict(run.stopwatch.seconds)
        start = time.perf_counter()
        run.loop(whole_episodes=False)
        # The last update may still run in the background: it is an update's time.
        run.stopwatch.timed("update", jax.block_until_ready)(run.state.num_updates)
        wall = time.perf_counter() - start
        working = sum(run.stopwatch.seconds.values()) - sum(before.values())
        run.outputs.close()
    frames_per_second = config.total_frames / wall
    episode_seconds = len(episode.actions) * config.action_repeat / frames_per_second
    return {
        **parts,
        "compile_seconds": compile_seconds,
        "frames_per_second": frames_per_second,
        "loop_overhead_percent": 100.0 * (wall / working - 1.0),
        "reward_percent": 100.0
        * parts["reward_ms"]
        / (parts["reward_ms"] + 1000.0 * episode_seconds),
        "peak_memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "device": f"{jax.devices()[0].platform}: {jax.devices()[0].device_kind}",
        "machine": python_platform.platform(),
        "config": config.to_dict(),
    }


def _update(run: Any) -> None:
    import jax

    run.update()
    jax.block_until_ready(run.state.num_updates)


def _random_episode(run: Any, config: Any) -> Any:
    """Returns an episode of random actions, drawn only as far as needed."""
    from jaxil.host.interaction import FinishedEpisode

    environment = run.environment
    num_steps = environment.episode_steps or 500
    rng = np.random.default_rng(config.seed)
    actions = rng.uniform(-1, 1, (num_steps, *environment.action_spec().shape))
    environment.reset(episode=0)
    frames = [environment.single_observation()]
    for action in actions[:20]:
        environment.step(action)
        frames.append(environment.single_observation())
    # Drawing 500 frames in software takes longer than all else here.
    frames = [frames[i % len(frames)] for i in range(num_steps + 1)]
    return FinishedEpisode(
        frames=np.stack(frames),
        actions=actions.astype(np.float32),
        task_rewards=np.zeros(num_steps, np.float32),
        discounts=np.ones(num_steps, np.float32),
    )


def _physics_ms(config: Any, repeats: int) -> float:
    from jaxil import experiment

    config = config.copy_and_resolve_references()
    with config.unlocked():
        config.observation = "state"  # which draws nothing
    environment = experiment.training_environment(config)
    environment.reset(episode=0)
    action = np.zeros(environment.action_spec().shape)
    return _median_ms(lambda: environment.step(action), repeats)


def _median_ms(function: Callable[[], Any], repeats: int) -> float:
    import jax

    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return 1000.0 * float(np.median(seconds))


def _define(values: flags.FlagValues) -> None:
    command.define_config(values)
    flags.DEFINE_string("json", None, "file for the results", flag_values=values)
    flags.DEFINE_integer(
        "repeats",
        10,
        "timings of each part",
        lower_bound=1,
        upper_bound=10_000,
        flag_values=values,
    )
    flags.DEFINE_integer(
        "steps",
        40,
        "decisions of the loop to time",
        lower_bound=2,
        upper_bound=1_000_000,
        flag_values=values,
    )


if __name__ == "__main__":
    command.run(main)
