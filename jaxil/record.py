"""Records demonstrations: of the best of several runs, or of a policy from outside."""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxil import outside
from jaxil.demonstrations import playing
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments import suite, tasks
from jaxil.environments.evaluation import evaluate
from jaxil.errors import Fault, UsageError, unknown_name
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
        try:
            loaded.append(trained.load(folder))
        except UsageError as error:
            faults += error.faults
    names = sorted({policy.config.task for policy, _ in loaded})
    if len(names) > 1:
        faults.append(
            f"--workdirs hold runs of different tasks ({', '.join(names)}); list runs "
            "of one task"
        )
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
    with assembly.environment_with_seed(best.config, _SEED) as environment:
        _write(
            output,
            environment,
            best,
            num_episodes=num_episodes,
            task=best.config.task,
            action_repeat=best.config.action_repeat,
            expert=f"{best.description()}; mean action, no noise",
        )


def policy(
    reference: str,
    output: pathlib.Path,
    *,
    task: str,
    action_repeat: int,
    image_size: int | None,
    num_episodes: int,
) -> None:
    """Records a policy from outside.

    Args:
      reference: its package.module:function.
      output: the file.
      task: any that jaxil knows.
      action_repeat: frames of one step.
      image_size: of the pixels of a task that is not dm_control's.
      num_episodes: at least 1.

    Raises:
      UsageError: policy or task cannot be used, or the file cannot be written.
    """
    faults: list[Fault | str] = []
    act = environment = None
    try:
        act = outside.load(reference, "--policy")
    except UsageError as error:
        faults += error.faults
    try:
        environment = _recorded_task(task, action_repeat, image_size)
    except UsageError as error:
        faults += error.faults
    if act is None or environment is None:
        if environment is not None:
            environment.close()
        raise UsageError(faults)
    try:
        with environment:
            _write(
                output,
                environment,
                act,
                num_episodes=num_episodes,
                task=task,
                action_repeat=action_repeat,
                expert=reference,
            )
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
    *,
    num_episodes: int,
    task: str,
    action_repeat: int,
    expert: str,
) -> None:
    """Records episodes and prints what they return."""
    try:
        returns = playing.record(
            output,
            environment,
            act,
            num_episodes=num_episodes,
            task=task,
            action_repeat=action_repeat,
            seed=_SEED,
            expert=expert,
            say=screen.say,
        )
    except (OSError, DemonstrationError) as error:
        raise UsageError(f"--output={output}: {error}") from error
    print(
        f"{output}: {len(returns)} episodes of {expert}, return mean "
        f"{np.mean(returns):.1f}, minimum {min(returns):.1f}, maximum "
        f"{max(returns):.1f}, {output.stat().st_size / 1e6:.2f} MB"
    )
