"""A task of one's own that gives what it is told."""

from typing import Any

import dm_env
import numpy as np
from dm_env import specs

BLACK = np.zeros((8, 8, 3), np.uint8)


class Task(dm_env.Environment):
    """Gives what it is told, and keeps the action that it gets."""

    def __init__(
        self,
        bounds: Any = None,
        image: Any = BLACK,
        reward: Any = 0.0,
        discount: Any = 1.0,
    ):
        self._bounds = bounds or specs.BoundedArray((1,), np.float64, -1.0, 1.0)
        self._image, self._reward, self._discount = image, reward, discount
        self.taken = np.zeros(0)

    def reset(self):
        return dm_env.restart(self._image)

    def step(self, action):
        self.taken = action
        return dm_env.transition(self._reward, self._image, self._discount)

    def observation_spec(self):
        return specs.Array(np.shape(self._image), np.asarray(self._image).dtype)

    def action_spec(self):
        return self._bounds


def bounded(low, high, dtype: Any = np.float64):
    return specs.BoundedArray((len(low),), dtype, np.array(low), np.array(high))
