"""Tasks of one's own that give what no agent can use: one message each."""

from typing import Any

import dm_env
import numpy as np
import pytest
from dm_env import specs

from jaxil.environments import tasks

_BLACK = np.zeros((8, 8, 3), np.uint8)


class Task(dm_env.Environment):
    """Gives what it is told, and keeps the action that it gets."""

    def __init__(
        self,
        bounds: Any = None,
        image: Any = _BLACK,
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
    return specs.BoundedArray((2,), dtype, np.array(low), np.array(high))


@pytest.mark.parametrize(
    ("faulty", "words"),
    [
        (lambda: Task(reward=None), "reward None; give a number, 0 if there is none"),
        (lambda: Task(reward=np.inf), "reward inf"),
        (lambda: Task(reward="much"), "reward 'much'"),
        (lambda: Task(discount=None), "discount None; give a number, in [0, 1]"),
        (lambda: Task(discount=1.5), "discount 1.5"),
        (lambda: Task(image=np.zeros((8, 8))), "it observes float64[8, 8]"),
        (lambda: Task(image=_BLACK / 2.0), "it observes float64[8, 8, 3]"),
        (lambda: Task(image={}), "it observes nothing"),
        (lambda: Task(bounded([-1, 0], [1, np.inf])), "one limit alone"),
        (lambda: Task(bounded([0, 0], [3, 3], np.int32)), "int32, but needs floats"),
        (lambda: Task(specs.Array((1,), np.float64)), "needs a bounded vector"),
    ],
)
def test_what_cannot_be_used_is_named(faulty, words, monkeypatch):
    monkeypatch.setitem(globals(), "faulty", faulty)
    (fault,) = tasks.problems(f"{__name__}:faulty", **settings())
    assert words in str(fault)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_have_the_range_and_type_of_the_task(dtype, monkeypatch):
    task = Task(bounded([0, -np.inf], [4, np.inf], dtype))
    monkeypatch.setitem(globals(), "of_type", lambda: task)
    environment = tasks.make_environment(f"{__name__}:of_type", seed=0)
    environment.reset()
    environment.step(np.array([0.5, 0.5], np.float32))
    assert task.taken.dtype == dtype
    np.testing.assert_array_equal(task.taken, [3.0, 0.5])  # no limit: [-1, 1]


def settings():
    return {
        "image_size": 8,
        "action_repeat": 1,
        "frame_stack": 1,
        "observation": "pixels",
        "render_quality": "paper",
        "camera": "",
        "distraction": "none",
    }
