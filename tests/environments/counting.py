"""Environments that count, for tests of what plays them."""

from typing import Any

import dm_env
import numpy as np

from jaxil.environments.player import InProcess


class Counting:
    """Frame t of episode e holds the number 10 e + t; a step is rewarded with t."""

    def __init__(self, episode_steps: Any = 3):
        """Takes the agent steps of an episode, or a function of its number."""
        self.episode_steps = episode_steps

    def close(self):
        pass

    def reset(self, episode):
        steps = self.episode_steps
        self.episode, self.time = episode, 0
        self.length = steps(episode) if callable(steps) else steps
        return dm_env.restart(self.single_observation())

    def step(self, action):
        del action
        self.time += 1
        end = dm_env.truncation if self.time == self.length else dm_env.transition
        return end(float(self.time), self.single_observation(), 0.5)

    def single_observation(self):
        return np.array([10.0 * self.episode + self.time], np.float32)


class InTurn:
    """Several environments that work when they are waited for.

    Attributes:
      tape: "step INDEX" is added when an environment is sent an action.
      received: answers so far.
      lost: numbers of the answers, from 0, with which an environment is lost.
    """

    def __init__(self, environments, tape=None, lost=()):
        self.size = len(environments)
        self.tape = [] if tape is None else tape
        self.received, self.lost = 0, set(lost)
        self._each = [InProcess(environment) for environment in environments]

    def reset(self, index, episode):
        self._each[index].reset(0, episode)

    def step(self, index, action):
        self.tape.append(f"step {index}")
        self._each[index].step(0, action)

    def receive(self, index):
        moment, number = self._each[index].receive(0), self.received
        self.received += 1
        return None if number in self.lost else moment

    def close(self):
        self.tape.append("close")
