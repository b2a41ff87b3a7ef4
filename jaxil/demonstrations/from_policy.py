"""Records a policy's episodes in a file of demonstrations."""

import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxil.demonstrations import playing, states
from jaxil.demonstrations.readers import own
from jaxil.demonstrations.readers.recording import Recording
from jaxil.environments import suite
from jaxil.errors import told_as


def record(
    output: pathlib.Path,
    environment: Any,
    act: Callable[[np.ndarray], Any],
    *,
    num_episodes: int,
    task: str,
    action_repeat: int,
    seed: int,
    expert: str,
    say: Callable[[str], None],
) -> list[float]:
    """Plays and writes episodes: simulator states if possible, else pixels.

    Args:
      output: the file, NAME.npz; replaced atomically.
      environment: a `PixelEnvironment` of the task, used by nothing else.
      act: observation to action [A] in [-1, 1]; without a state of its own, since it
        plays again if episodes of states turn out to differ in length.
      num_episodes: at least 1.
      task: its name, as in configs.
      action_repeat: the environment's.
      seed: the environment's.
      expert: what `act` is, in words.
      say: receives a message if states cannot be recorded.

    Returns:
      Each episode's task return.

    Raises:
      ValueError: an action or a reward cannot be stored.
      EnvironmentsFailed: the task or the policy raised an error.
      OSError: the file cannot be written.
    """
    shape, seconds = environment.action_spec().shape, environment.step_seconds

    def decide(step: int, observation: np.ndarray) -> np.ndarray:
        with told_as("the policy", f"step {step}"):
            action = np.asarray(act(observation), np.float32)
        if action.shape != shape:
            raise ValueError(f"returned shape {action.shape}; the task takes {shape}.")
        if not np.all(np.abs(action) <= 1.0):  # nor NaN
            raise ValueError(f"returned {action} at step {step}, not in [-1, 1].")
        return action

    returns: list[float] = []
    play: dict[str, Any] = {
        "environment": environment,
        "begin": lambda episode: decide,
        "num_episodes": num_episodes,
        "finished": lambda episode, task_return: returns.append(task_return),
    }
    is_of_suite = isinstance(environment, suite.SuiteEnvironment)
    if is_of_suite and environment.has_mocap_bodies:
        say("The task has mocap bodies, so pixels are recorded, not states")
    elif is_of_suite:
        try:
            arrays = playing.play(**play)
        except playing.LengthsDiffer as error:
            say(f"{error}, so pixels are recorded, not states")
            returns.clear()
        else:
            metadata = states.new_metadata(
                task=task,
                action_repeat=action_repeat,
                seed=seed,
                first_episode=0,
                expert=expert,
                rewards=arrays["rewards"],
            )
            states.write_states(
                output, states.StateDemonstrations(**arrays, metadata=metadata)
            )
            return returns
    recording = Recording(
        "jaxil pixels",
        num_episodes,
        playing.play_pixels(**play),
        task=task,
        action_repeat=action_repeat,
        frames_per_second=seconds and 1.0 / seconds,
    )
    own.write_pixels(output, recording, origin=f"recorded, {expert}")
    return returns
