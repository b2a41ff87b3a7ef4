"""A recording of random actions: the states to store, and the frames seen."""

import pathlib

import numpy as np

from jaxil.demonstrations import loading, states
from jaxil.demonstrations.states import StateDemonstrations
from jaxil.environments.tasks import make_environment

TASK = "finger_turn_hard"  # its target is not part of the simulator's state
NUM_EPISODES, NUM_STEPS, SIZE = 2, 4, 16
SEED, FIRST_EPISODE = 5, 3
VIEW = {"image_size": SIZE, "render_quality": "fast"}


def play(environment, episode: int, actions: np.ndarray):
    """Plays; returns states and frames, one more than actions, and the rewards."""
    environment.reset(episode=episode)
    visited, frames = [environment.simulator_state()], [environment.frame()]
    rewards = []
    for action in actions:
        rewards.append(environment.step(action).reward)
        visited.append(environment.simulator_state())
        frames.append(environment.frame())
    arrays = {name: np.stack([each[name] for each in visited]) for name in visited[0]}
    return arrays, np.stack(frames), np.array(rewards, np.float32)


def record():
    """Plays at random; returns the states to store and the frames that were seen."""
    environment = make_environment(TASK, seed=SEED, action_repeat=2, **VIEW)
    shape = (NUM_EPISODES, NUM_STEPS, 2)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    played = [
        play(environment, FIRST_EPISODE + index, chosen)
        for index, chosen in enumerate(actions)
    ]
    environment.close()
    visited = [each[0] for each in played]
    arrays = {name: np.stack([each[name] for each in visited]) for name in visited[0]}
    frames = np.stack([each[1] for each in played])
    rewards = np.stack([each[2] for each in played])
    metadata = states.new_metadata(
        task=TASK,
        action_repeat=2,
        seed=SEED,
        expert="uniform actions",
        rewards=rewards,
    )
    metadata["first_episode"] = FIRST_EPISODE
    recorded = StateDemonstrations(
        **arrays, actions=actions, rewards=rewards, metadata=metadata
    )
    return recorded, frames


RECORDED, FRAMES = record()


def write_recorded(folder: pathlib.Path) -> pathlib.Path:
    """Writes all of it to a file; returns its path."""
    path = folder / "demonstrations.npz"
    states.write_states(path, RECORDED)
    return path


def load(path, **changes):
    arguments = {"task": TASK, "num_episodes": NUM_EPISODES, "action_repeat": 2, **VIEW}
    return loading.load(path, **(arguments | changes))


def assert_same(first: StateDemonstrations, second: StateDemonstrations):
    assert first.metadata == second.metadata
    for one, other in zip(first[:-1], second[:-1], strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
