"""Plays a trained policy and keeps the simulator's states."""

from typing import Any

import numpy as np

from jaxil.demonstrations import states
from jaxil.training import assembly
from jaxil.training.trained import Trained

_STATE_NAMES = ("qpos", "qvel", "act")


def record(run: Trained, *, num_episodes: int, seed: int) -> states.StateDemonstrations:
    """Returns deterministic episodes of a policy, from different resets.

    Args:
      run: the policy; its own environment is not touched.
      num_episodes: K.
      seed: of the resets.
    """
    environment = assembly.environment_with_seed(run.config, seed)
    all_states: dict[str, list[Any]] = {name: [] for name in _STATE_NAMES}
    all_actions, all_rewards = [], []
    for episode in range(num_episodes):
        timestep = environment.reset(episode=episode)
        visited, actions, rewards = [environment.simulator_state()], [], []
        while not timestep.last():
            action = run.act(timestep.observation)
            timestep = environment.step(action)
            visited.append(environment.simulator_state())
            actions.append(action)
            rewards.append(timestep.reward)
        for name in _STATE_NAMES:
            all_states[name].append(np.stack([state[name] for state in visited]))
        all_actions.append(np.stack(actions))
        all_rewards.append(rewards)
    rewards = np.asarray(all_rewards, np.float32)
    config = run.config
    return states.StateDemonstrations(
        **{name: np.stack(episodes) for name, episodes in all_states.items()},
        actions=np.stack(all_actions).astype(np.float32),
        rewards=rewards,
        metadata=states.new_metadata(
            task=config.task,
            action_repeat=config.action_repeat,
            seed=seed,
            first_episode=0,
            expert=f"{run.description()}; mean action, no noise",
            rewards=rewards,
        ),
    )
