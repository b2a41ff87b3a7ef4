"""A drawing that moves with the actions: nothing is simulated. And its agents."""

import dataclasses
import functools
from typing import Any

import dm_env
import jax
import jax.numpy as jnp
import numpy as np
from dm_env import specs

from jaxil import config as jaxil_config
from jaxil.demonstrations.loading import Demonstrations
from jaxil.training import agent as agents

SIDE, STEPS, EPISODES = 12, 21, 5
REAL_MAKE_AGENT = agents.make_agent


class Drawing:
    """Episodes of 21 steps, in which a square goes where the actions lead it."""

    episode_steps = STEPS

    def close(self):
        pass

    def reset(self, episode):
        self._rng = np.random.default_rng(episode)
        self._time, self._place = 0, np.full(2, SIDE / 2)
        self._frames = [self.single_observation()] * 3
        return dm_env.restart(self._observation())

    def step(self, action):
        self._time += 1
        self._place = np.clip(self._place + 2 * np.asarray(action), 1, SIDE - 2)
        self._frames = [*self._frames[1:], self.single_observation()]
        end = dm_env.truncation if self._time == STEPS else dm_env.transition
        return end(float(self._place[0]), self._observation(), 1.0)

    def single_observation(self):
        row, column = self._place.astype(int)
        noise = np.random.default_rng([self._time, row, column])
        frame = noise.integers(0, 100, (SIDE, SIDE, 3), dtype=np.uint8)
        frame[row - 1 : row + 2, column - 1 : column + 2] = 250
        return frame

    def _observation(self):
        return np.concatenate(self._frames, axis=-1)

    def action_spec(self):
        return specs.BoundedArray((2,), np.float32, -1.0, 1.0)

    def observation_spec(self):
        return specs.Array((SIDE, SIDE, 9), np.uint8)


def make_config(method, **changes):
    config = jaxil_config.default_config(method, "walker_walk")
    config.update(
        image_size=SIDE,
        action_repeat=1,
        update_every_steps=1,
        seed_frames=STEPS,
        exploration_steps=10,
        total_frames=STEPS * EPISODES,
        replay_size_steps=2 * STEPS + 5,  # the ring runs over its end
        batch_size=8,
        num_steps=3,
        hidden_dim=16,
        feature_dim=8,
        shift_padding=1,
        eval_every_frames=10**9,
        num_eval_episodes=1,
        checkpoint_every_frames=2 * STEPS,
        video_every_evals=0,
    )
    config.encoder.channels = (4, 4)
    config.encoder.kernel_sizes, config.encoder.strides = (3, 3), (2, 1)
    sizes = {"batch_size": 4, "hidden_dim": 16}
    for section in {"discriminator", "cloning"} & set(config):
        config[section].update({n: sizes[n] for n in sizes if n in config[section]})
    config.update(changes)
    return config


def make_demonstrations():
    drawing, rng = Drawing(), np.random.default_rng(9)
    frames, actions = [], rng.uniform(-1, 1, (2, STEPS, 2)).astype(np.float32)
    for episode in range(2):
        drawing.reset(episode)
        frames.append([drawing.single_observation()])
        for action in actions[episode]:
            drawing.step(action)
            frames[-1].append(drawing.single_observation())
    lengths = np.array([STEPS + 1, STEPS - 3])
    metadata = {"returns": [], "task": "walker_walk"}
    return Demonstrations(np.array(frames), lengths, actions, None, metadata)


@functools.cache
def make_agent(method):
    """Compiles once for all runs, and draws the first state once."""
    environment: Any = Drawing()
    agent = REAL_MAKE_AGENT(make_config(method), environment, make_demonstrations())
    start = agent.init_state()
    init_state = functools.partial(jax.tree.map, jnp.copy, start)
    return dataclasses.replace(agent, init_state=init_state)
