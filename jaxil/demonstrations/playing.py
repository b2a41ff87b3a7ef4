"""Records episodes of simulator states."""

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
    """Plays episodes 0 ... K - 1; returns the arrays of `StateDemonstrations`.

    Args:
      environment: used by nothing else.
      begin: episode number -> its controller; called after the reset.
      num_episodes: K.
      finished: called with each episode's number and return.
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
