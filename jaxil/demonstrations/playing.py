"""Plays episodes and keeps the simulator's states."""

from collections.abc import Callable

import numpy as np

from jaxil.environments.pixel_environment import PixelEnvironment

Decide = Callable[[int, np.ndarray], np.ndarray]  # step, observation -> action [A]


def play(
    environment: PixelEnvironment,
    begin: Callable[[int], Decide],
    num_episodes: int,
    finished: Callable[[int, float], None] = lambda episode, task_return: None,
) -> dict[str, np.ndarray]:
    """Plays episodes 0 ... K - 1; returns `StateDemonstrations` without metadata.

    Args:
      environment: used by nothing else.
      begin: episode -> what decides in it, called after its reset.
      num_episodes: K.
      finished: called with each episode's number and return.

    Returns:
      `qpos`, `qvel`, `act`, `actions` and `rewards`, each [K, ...].
    """
    episodes = []
    for episode in range(num_episodes):
        timestep = environment.reset(episode=episode)
        decide = begin(episode)
        states, actions, rewards = [environment.simulator_state()], [], []
        while not timestep.last():
            action = decide(len(actions), timestep.observation)
            actions.append(np.asarray(action, np.float32))
            timestep = environment.step(actions[-1])
            rewards.append(timestep.reward)
            states.append(environment.simulator_state())
        played = {name: np.stack([each[name] for each in states]) for name in states[0]}
        played["actions"] = np.stack(actions)
        played["rewards"] = np.asarray(rewards, np.float32)
        episodes.append(played)
        finished(episode, sum(rewards))
    return {name: np.stack([each[name] for each in episodes]) for name in episodes[0]}
