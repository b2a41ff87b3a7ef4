"""Tasks of dm_control and of one's own that are legal, but not what the suite does."""

import contextlib
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from dm_control import mujoco
from dm_control.rl import control
from dm_control.suite import base
from dm_control.suite.wrappers import pixels

from jaxil.demonstrations import playing
from jaxil.demonstrations.readers import own
from jaxil.environments import observations, suite, tasks
from tests.own_task import Task, bounded

_MODEL = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="above" pos="0 0 2"/>
    <camera name="near" pos="0 0 1"/>
    <body name="target" mocap="true"><geom size=".2" rgba="{colour} 0 1"/></body>
    <body pos=".5 0 0">
      <joint name="hinge" axis="0 0 1"/><geom size=".1" rgba="0 0 1 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""
COLOUR = "1 0"


class Moving(base.Task):
    """As the suite's tasks are built; its target moves and is no part of a state."""

    def initialize_episode(self, physics):
        super().initialize_episode(physics)
        physics.data.mocap_pos[0] = 0.0

    def before_step(self, action, physics):
        super().before_step(action, physics)
        physics.data.mocap_pos[0, 0] += 0.1

    def get_observation(self, physics):
        return {"position": physics.data.qpos.copy()}

    def get_reward(self, physics):
        return 0.5


def moving():
    physics = mujoco.Physics.from_xml_string(_MODEL.format(colour=COLOUR))
    return control.Environment(physics, Moving(random=0), time_limit=0.02)


def wrapped():
    view = {"height": 16, "width": 16, "camera_id": 1}
    return pixels.Wrapper(moving(), render_kwargs=view)


def make(function, **settings):
    return tasks.make_environment(f"{__name__}:{function}", seed=0, **settings)


@contextlib.contextmanager
def closing(*environments):
    with contextlib.ExitStack() as stack:
        for environment in environments:
            stack.callback(environment.close)
        yield


def test_the_largest_action_is_inside_bounds_that_are_no_binary_fractions(monkeypatch):
    task = Task(bounded([-0.1], [0.3]))
    monkeypatch.setitem(globals(), "own", lambda: task)
    environment = make("own")
    environment.reset()
    for action in (-1.0, 1.0):
        environment.step(np.array([action]))
        assert -0.1 <= task.taken[0] <= 0.3


def test_a_task_that_changes_its_action_gets_each_frame_the_same(monkeypatch):
    task, seen = Task(), []

    def step(action):
        seen.append(action.copy())
        action *= 2.0
        return Task.step(task, action)

    task.step = step
    monkeypatch.setitem(globals(), "own", lambda: task)
    environment = make("own", action_repeat=3)
    environment.reset()
    environment.step(np.array([0.25]))
    np.testing.assert_array_equal(seen, [[0.25]] * 3)


def test_a_duration_may_be_any_number(monkeypatch):
    task = Task()
    task.frame_seconds = np.float32(0.5)  # pyright: ignore
    monkeypatch.setitem(globals(), "own", lambda: task)
    seconds = make("own", action_repeat=2).step_seconds
    assert (type(seconds), seconds) == (float, 1.0)


def test_what_is_moved_from_outside_is_part_of_a_films_state():
    environment, other = make("moving", image_size=24), make("moving", image_size=24)
    assert isinstance(environment, suite.SuiteEnvironment)
    assert isinstance(other, suite.SuiteEnvironment)
    with closing(environment, other):
        environment.reset(episode=0)
        first = environment.frame()
        environment.step(np.ones(1))
        assert not np.array_equal(environment.frame(), first)
        other.reset(episode=0)
        other.set_simulator_state(**environment.simulator_state())
        np.testing.assert_array_equal(other.frame(), environment.frame())


def test_what_is_moved_from_outside_is_recorded_as_pixels(tmp_path):
    said = []
    with make("moving", image_size=16) as environment:
        playing.record(
            tmp_path / "moving.npz",
            environment,
            lambda observation: np.zeros(1),
            num_episodes=1,
            task=f"{__name__}:moving",
            action_repeat=1,
            seed=0,
            expert="nobody",
            say=said.append,
        )
    assert own.recognises(tmp_path / "moving.npz")
    assert "mocap bodies" in said[0]


def test_a_changed_model_has_another_digest(monkeypatch):
    def digest():
        environment = make("moving", image_size=16)
        assert isinstance(environment, suite.SuiteEnvironment)
        with closing(environment):
            return environment.model_digest()

    before = digest()
    assert digest() == before
    monkeypatch.setitem(globals(), "COLOUR", "0 1")
    assert digest() != before


def test_an_image_that_a_task_of_the_suite_observes_is_used_and_it_is_seeded():
    environment = make("wrapped", image_size=16, frame_stack=1)
    assert not isinstance(environment, suite.SuiteEnvironment)
    with closing(environment):
        seen = environment.reset(episode=0).observation
        physics = environment._simulator._inner.physics
        np.testing.assert_array_equal(seen, physics.render(16, 16, camera_id=1))
        states = []
        for episode in (0, 1, 0):
            environment.reset(episode=episode)
            states.append(environment._simulator._inner.task.random.rand())
        assert states[0] == states[2] != states[1]


class Arena(gymnasium.Env):
    """An environment whose width is no number of pixels."""

    metadata: ClassVar[Any] = {"render_modes": ["rgb_array"]}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, width=10.0, height=10.0, render_mode=None):
        self.size, self.render_mode = (width, height), render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def render(self):
        return np.zeros((32, 32, 3), np.uint8)


def test_only_mujocos_environments_are_told_the_size_of_images():
    gymnasium.register("Arena-v0", entry_point=f"{__name__}:Arena")
    with tasks.make_environment("gymnasium:Arena-v0", seed=0) as environment:
        assert environment._simulator._inner.unwrapped.size == (10.0, 10.0)
    name = "gymnasium:InvertedPendulum-v5"
    with tasks.make_environment(name, seed=0, image_size=24) as environment:
        environment.reset(episode=0)
        assert environment._simulator.render().shape == (24, 24, 3)


@pytest.mark.parametrize("shape", [(8, 6, 3), (1, 8, 6, 3)])
def test_composers_images_have_a_leading_axis(shape):
    image = np.zeros(shape, np.uint8)
    (found,) = observations.images_in({"camera": image, "angle": np.zeros(1)})
    assert found.shape == (8, 6, 3)
    assert observations.flat_state({"camera": image, "angle": np.ones(1)}) == 1.0
