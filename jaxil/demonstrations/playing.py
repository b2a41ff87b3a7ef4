"""Records episodes as simulator states, or as pixels where a task has none."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxil.demonstrations.readers.recording import PixelEpisode
from jaxil.errors import told_as

Decide = Callable[[int, np.ndarray], np.ndarray]  # step, observation -> action [A]
Begin = Callable[[int], Decide]  # episode number -> its controller, after the reset
Finished = Callable[[int, float], None]  # episode number, return


class LengthsDiffer(ValueError):
    """Episodes have different lengths, which a file of states cannot hold."""


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
    for states, actions, rewards in _played(
        environment, begin, num_episodes, finished, look
    ):
        if episodes and len(actions) != len(episodes[0]["actions"]):
            raise LengthsDiffer("episodes differ in length")
        played = {name: np.stack([each[name] for each in states]) for name in states[0]}
        episodes.append({**played, "actions": actions, "rewards": rewards})
    return {name: np.stack([each[name] for each in episodes]) for name in episodes[0]}


def play_pixels(
    environment: Any, begin: Begin, num_episodes: int, finished: Finished
) -> Iterator[PixelEpisode]:
    """Plays like `play`, in any environment; yields one episode at a time."""
    for frames, actions, rewards in _played(
        environment, begin, num_episodes, finished, environment.frame
    ):
        yield PixelEpisode(np.stack(frames), actions, rewards)


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
