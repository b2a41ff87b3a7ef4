"""Records demonstrations: of the best of several runs, or of a policy from outside."""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxil import outside
from jaxil.demonstrations import playing
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments import suite, tasks
from jaxil.environments.evaluation import evaluate
from jaxil.errors import Fault, UsageError, collecting, unknown_name
from jaxil.machine import screen
from jaxil.training import assembly, trained

_NUM_EVAL_EPISODES = 10
_SEED = 777  # of the recording environment; no training or evaluation uses it


def best_of_runs(
    folders: Sequence[pathlib.Path], output: pathlib.Path, *, num_episodes: int
) -> None:
    """Evaluates the policies of runs of one task, and records the best.

    Raises:
      UsageError: a run cannot be loaded, their tasks differ, or the file cannot be
        written.
    """
    loaded, faults = [], []
    for folder in folders:
        with collecting(faults):
            loaded.append(trained.load(folder))
    names = sorted({policy.config.task for policy, _ in loaded})
    if len(names) > 1:
        rule = f"hold runs of different tasks ({', '.join(names)})"
        faults.append(f"--workdirs {rule}; list runs of one task")
    if faults:
        for _, environment in loaded:
            environment.close()
        raise UsageError(faults)
    means = []
    print(f"{'mean':>8}{'std':>8}{'frames':>10}{'minutes':>9}  run")
    for folder, (policy, environment) in zip(folders, loaded, strict=True):
        with environment:
            evaluation = evaluate(
                environment, policy, num_episodes=_NUM_EVAL_EPISODES, first_episode=0
            )
        means.append(evaluation.mean)
        print(
            f"{evaluation.mean:>8.1f}{evaluation.std:>8.1f}{policy.frame:>10}"
            f"{policy.seconds / 60:>9.0f}  {folder}",
            flush=True,
        )
    best, _ = loaded[int(np.argmax(means))]
    expert = f"{best.description()}; mean action, no noise"
    settings = {name: best.config[name] for name in ("task", "action_repeat")}
    with assembly.environment_with_seed(best.config, _SEED) as environment:
        _write(output, environment, best, expert, num_episodes, settings)


def policy(
    reference: str,
    output: pathlib.Path,
    *,
    task: str,
    action_repeat: int,
    image_size: int | None,
    num_episodes: int,
) -> None:
    """Records a policy from outside, the function that `reference` names.

    `image_size` is that of the pixels of a task that is not dm_control's.

    Raises:
      UsageError: policy or task cannot be used, or the file cannot be written.
    """
    faults: list[Fault | str] = []
    act = environment = None
    with collecting(faults):
        act = outside.load(reference, "--policy")
    with collecting(faults):
        environment = _recorded_task(task, action_repeat, image_size)
    if act is None or environment is None:
        if environment is not None:
            environment.close()
        raise UsageError(faults)
    settings = {"task": task, "action_repeat": action_repeat}
    try:
        with environment:
            _write(output, environment, act, reference, num_episodes, settings)
    except ValueError as error:
        raise UsageError(f"--policy={reference}: {error}") from error


def _recorded_task(task: str, action_repeat: int, image_size: int | None) -> Any:
    known = suite.known_tasks()
    if tasks.is_of_suite(task) and task not in known:
        raise UsageError(unknown_name("--task", task, known))
    try:
        return tasks.make_recorded(
            task, image_size=image_size, seed=_SEED, action_repeat=action_repeat
        )
    except ValueError as error:
        raise UsageError(f"--task={task}: {error}") from error


def _write(
    output: pathlib.Path,
    environment: Any,
    act: Callable[[Any], Any],
    expert: str,
    num_episodes: int,
    settings: Mapping[str, Any],
) -> None:
    """Records episodes of an expert and prints what they return."""
    try:
        returns = playing.record(
            output,
            environment,
            act,
            num_episodes=num_episodes,
            seed=_SEED,
            expert=expert,
            say=screen.say,
            **settings,
        )
    except (OSError, DemonstrationError) as error:
        raise UsageError(f"--output={output}: {error}") from error
    print(
        f"{output}: {len(returns)} episodes of {expert}, return mean "
        f"{np.mean(returns):.1f}, minimum {min(returns):.1f}, maximum "
        f"{max(returns):.1f}, {output.stat().st_size / 1e6:.2f} MB"
    )
