"""Plays episodes and records them: as simulator states, or else as pixels."""

import math
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxil.demonstrations import states
from jaxil.demonstrations.readers import own
from jaxil.demonstrations.readers.recording import PixelEpisode, Recording
from jaxil.environments import suite
from jaxil.errors import told_as

Decide = Callable[[int, np.ndarray], np.ndarray]  # step, observation -> action [A]
Begin = Callable[[int], Decide]  # episode number -> its controller, after the reset
Finished = Callable[[int, float], None]  # episode number, return


class LengthsDiffer(ValueError):
    """Episodes have different lengths, which a file of states cannot hold."""


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
    """Records a policy's episodes: as simulator states if possible, else as pixels.

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

    def finished(_: int, task_return: float) -> None:
        returns.append(task_return)

    how = environment, lambda episode: decide, num_episodes, finished
    is_of_suite = isinstance(environment, suite.SuiteEnvironment)
    if is_of_suite and environment.has_mocap_bodies:
        say("The task has mocap bodies, so pixels are recorded, not states")
    elif is_of_suite:
        try:
            arrays = play(*how)
        except LengthsDiffer as error:
            say(f"{error}, so pixels are recorded, not states")
            returns.clear()
        else:
            metadata = states.new_metadata(
                task=task,
                action_repeat=action_repeat,
                seed=seed,
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
        (
            PixelEpisode(np.stack(frames), actions, rewards)
            for frames, actions, rewards in _played(*how, environment.frame)
        ),
        task=task,
        action_repeat=action_repeat,
        frames_per_second=seconds and 1.0 / seconds,
    )
    own.write_pixels(output, recording, origin=f"recorded, {expert}")
    return returns


def play(
    environment: Any, begin: Begin, num_episodes: int, finished: Finished
) -> dict[str, np.ndarray]:
    """Plays episodes 0 ... K - 1; returns the arrays of `StateDemonstrations`.

    `environment` is a `SuiteEnvironment`, and used by nothing else.

    Raises:
      LengthsDiffer: an episode ended sooner, or later, than the first.
    """
    episodes = []
    look = environment.simulator_state
    for visited, actions, rewards in _played(
        environment, begin, num_episodes, finished, look
    ):
        if episodes and len(actions) != len(episodes[0]["actions"]):
            raise LengthsDiffer("episodes differ in length")
        names = visited[0]
        played = {name: np.stack([each[name] for each in visited]) for name in names}
        episodes.append({**played, "actions": actions, "rewards": rewards})
    return {name: np.stack([each[name] for each in episodes]) for name in episodes[0]}


def _played(
    environment: Any,
    begin: Begin,
    num_episodes: int,
    finished: Finished,
    look: Callable[[], Any],
) -> Iterator[tuple[list[Any], np.ndarray, np.ndarray]]:
    """Yields `look()` at the N + 1 times of an episode, actions [N, A], rewards [N]."""
    for episode in range(num_episodes):
        with told_as("the task", "a reset"):
            timestep = environment.reset(episode=episode)
            seen = [look()]
        decide, actions, rewards = begin(episode), [], []
        while not timestep.last():
            action = decide(len(actions), timestep.observation)
            actions.append(np.asarray(action, np.float32))
            with told_as("the task", "a step"):
                timestep = environment.step(actions[-1])
                seen.append(look())
            if not math.isfinite(timestep.reward):
                raise ValueError(
                    f"the task's reward is {timestep.reward} after step {len(rewards)} "
                    f"of episode {episode}"
                )
            rewards.append(timestep.reward)
        finished(episode, sum(rewards))
        yield seen, np.stack(actions), np.asarray(rewards, np.float32)
