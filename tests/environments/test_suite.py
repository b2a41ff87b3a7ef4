"""The environment against the raw suite, against itself replayed, and by hand."""

import re

import dm_env
import numpy as np
import pytest
from dm_control import suite as dm_suite
from dm_control.rl import control
from dm_control.suite import pendulum
from dm_env import specs

from jaxil.environments import suite
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.environments.suite import SuiteEnvironment
from jaxil.environments.tasks import make_environment

SIZE = 24
# Plain, with a moving camera, with a string, with a target drawn at each reset.
TASKS = ("cartpole_swingup", "walker_walk", "ball_in_cup_catch", "finger_turn_hard")

_made: list[PixelEnvironment] = []


def small(task="cartpole_swingup", **changes) -> SuiteEnvironment:
    environment = make_environment(
        task, **({"seed": 1, "image_size": SIZE, "render_quality": "fast"} | changes)
    )
    assert isinstance(environment, SuiteEnvironment)
    _made.append(environment)
    return environment


@pytest.fixture(autouse=True)
def _close_environments():
    """GL contexts are few on some machines."""
    yield
    while _made:
        _made.pop().close()


def random_actions(environment, number):
    shape = (number, *environment.action_spec().shape)
    return np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)


class Countdown:
    """Rewards 1, 2, 4, 8, 16, and then the end."""

    step_limit = 5

    def __init__(self):
        self.seen = {"position": np.array([[1.0, 2.0]]), "height": np.float64(3.0)}

    def reset(self):
        self.controls = []
        return dm_env.restart(self.seen)

    def step(self, control):
        reward = 2.0 ** len(self.controls)
        self.controls.append(control)
        if len(self.controls) == self.step_limit:
            return dm_env.termination(reward, self.seen)
        return dm_env.transition(reward, self.seen, discount=0.5)

    def observation_spec(self):
        return {
            "position": specs.Array((1, 2), np.float64),
            "height": specs.Array((), np.float64),
        }

    def action_spec(self):
        return specs.BoundedArray((2,), np.float64, [0.0, -1e10], [10.0, 1e10])


def countdown(simulator=None) -> PixelEnvironment:
    settings = {"seed": 0, "action_repeat": 2, "image_size": SIZE, "frame_stack": 3}
    return PixelEnvironment(simulator or Countdown(), **settings, observation="state")


# --- time ---------------------------------------------------------------------------


def test_action_repeat_sums_rewards_and_multiplies_discounts():
    environment = countdown()
    environment.reset()
    steps = [environment.step(np.zeros(2)) for _ in range(3)]
    # 1 + 2, 4 + 8, and 16 alone: the episode ends inside the third step.
    assert [step.reward for step in steps] == [3.0, 12.0, 16.0]
    assert [step.discount for step in steps] == [0.25, 0.25, 0.0]
    assert [step.last() for step in steps] == [False, False, True]
    assert environment.episode_steps == 3
    assert environment.step(np.zeros(2)).first(), "a step after the end resets"


@pytest.mark.parametrize("action_repeat", [1, 3])
def test_rewards_are_those_of_the_raw_suite(action_repeat):
    environment = small("walker_walk", action_repeat=action_repeat, observation="state")
    raw = dm_suite.load("walker", "walk")
    environment.reset(episode=4)
    raw.reset()
    with raw.physics.reset_context():
        raw.physics.data.qpos[:] = environment.simulator_state()["qpos"]
        raw.physics.data.qvel[:] = environment.simulator_state()["qvel"]
    for action in random_actions(environment, 20):
        expected = sum(raw.step(action).reward for _ in range(action_repeat))
        assert environment.step(action).reward == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("action_repeat", "num_steps"), [(2, 500), (3, 334)])
def test_a_time_limit_keeps_the_discount_at_one(action_repeat, num_steps):
    environment = small(observation="state", action_repeat=action_repeat)
    assert environment.episode_steps == num_steps
    step, count = environment.reset(), 0
    while not step.last():
        step, count = environment.step(np.zeros(1)), count + 1
        assert step.discount == 1.0
    assert count == num_steps


# --- actions --------------------------------------------------------------------------


def test_actions_are_rescaled_to_the_tasks_bounds():
    simulator = Countdown()
    environment = countdown(simulator)
    environment.reset()
    environment.step(np.array([-1.0, -1.0]))
    environment.step(np.array([1.0, 0.25]))
    controls = simulator.controls
    # [0, 10] is filled; an actuator without bounds gets the action as it is.
    np.testing.assert_allclose(controls[0], [0.0, -1.0])
    np.testing.assert_allclose(controls[2], [10.0, 0.25])
    assert environment.action_spec().dtype == np.float32
    assert float(environment.action_spec().minimum) == -1.0


def test_an_action_of_another_shape_is_refused():
    environment = small("walker_walk", observation="state")
    environment.reset()
    with pytest.raises(ValueError, match=r"shape \(1,\), expected \(6,\)"):
        environment.step(np.zeros(1))


# --- observations ---------------------------------------------------------------------


def test_the_stack_starts_with_copies_and_ends_with_the_newest():
    environment = small("walker_walk")
    frames = [environment.reset().observation[..., -3:]]
    first = environment.reset(episode=0).observation
    for index in range(3):
        np.testing.assert_array_equal(first[..., 3 * index : 3 * index + 3], frames[0])
    for action in random_actions(environment, 4):
        observation = environment.step(action).observation
        frames.append(environment.single_observation())
        assert not np.array_equal(frames[-1], frames[-2]), "the camera stands still"
        expected = [frames[max(len(frames) - 1 - age, 0)] for age in (2, 1, 0)]
        np.testing.assert_array_equal(observation, np.concatenate(expected, axis=2))
    environment.observation_spec().validate(first)


def test_frames_are_copies():
    environment = small("walker_walk")
    environment.reset()
    frames, at_once = [], []
    for action in random_actions(environment, 5):
        environment.step(action)
        frames.append(environment.renderer.render())
        at_once.append(frames[-1].tobytes())
    assert [frame.tobytes() for frame in frames] == at_once
    assert len(set(at_once)) == 5

    environment.frame()[:] = 0
    environment.single_observation()[:] = 0
    assert environment.frame().tobytes() == at_once[-1]
    after = environment.step(np.zeros(6)).observation
    assert after[..., 3:6].tobytes() == at_once[-1]


def test_states_are_flat_and_drawn_only_when_asked():
    environment = countdown()
    np.testing.assert_array_equal(environment.reset().observation, [1.0, 2.0, 3.0])
    assert environment.observation_spec().shape == (3,)

    real = small("walker_walk", observation="state")
    real.observation_spec().validate(real.reset().observation)
    assert real.frame().shape == (SIZE, SIZE, 3)


def test_qualities_look_different():
    paper, fast = (
        small(render_quality=quality).reset().observation.astype(int)
        for quality in ("paper", "fast")
    )
    assert 0.0 < np.abs(paper - fast).mean() < 20.0, "the same scene, drawn in two ways"


def test_smooth_is_the_mean_of_four_pixels_of_fast():
    fast = small(image_size=2 * SIZE).reset().observation.astype(int)
    means = fast.reshape(SIZE, 2, SIZE, 2, -1).mean((1, 3))
    smooth = small(render_quality="smooth").reset().observation
    assert smooth.shape == (SIZE, SIZE, 9)
    np.testing.assert_allclose(smooth, means, atol=0.5)


def test_cameras_are_chosen_by_name_or_number():
    usual = small("walker_walk").reset(0).observation
    for camera in ("0", "side"):
        seen = small("walker_walk", camera=camera).reset(0).observation
        np.testing.assert_array_equal(seen, usual)
    back = small("walker_walk", camera="back").reset(0).observation
    assert not np.array_equal(back, usual)
    with pytest.raises(ValueError, match="the task has: 0 side, 1 back"):
        small("walker_walk", camera="front")


def test_distractions_are_fixed_by_seed_and_number_and_grow_with_their_strength():
    plain = small("walker_walk").reset(0).observation.astype(int)
    distances = []
    for strength in ("none", "easy", "medium", "hard"):
        environment, other = (
            small("walker_walk", distraction=strength) for _ in range(2)
        )
        first = environment.reset(0).observation
        np.testing.assert_array_equal(other.reset(0).observation, first)
        distances.append(np.abs(first - plain).mean())
        if strength != "none":
            assert not np.array_equal(other.reset(1).observation, first)
            # The physics are those of the task alone.
            state = small("walker_walk", observation="state").reset(0).observation
            seen = small("walker_walk", observation="state", distraction=strength)
            np.testing.assert_array_equal(seen.reset(0).observation, state)
    assert distances[0] == 0.0
    assert distances == sorted(distances)
    assert distances[1] > 5.0


def without_cameras():
    xml, assets = pendulum.get_model_and_assets()
    physics = pendulum.Physics.from_xml_string(re.sub(rb"<camera.*", b"", xml), assets)
    return control.Environment(physics, pendulum.SwingUp(random=0))


def test_a_model_without_cameras_is_seen_by_the_free_one():
    for look in ("none", "hard"):
        task = f"{__name__}:without_cameras"
        made = make_environment(task, seed=0, image_size=SIZE, distraction=look)
        _made.append(made)
        assert _made[-1].reset(0).observation.std() > 0


# --- reproducibility ------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_stored_states_give_the_same_pixels(task):
    environment, other = small(task), small(task)
    environment.reset(episode=3)
    stored = []
    for action in random_actions(environment, 4):
        environment.step(action)
        stored.append((environment.simulator_state(), environment.frame()))
    other.reset(episode=0)
    other.reset(episode=3)
    for state, frame in reversed(stored):
        other.set_simulator_state(**state)
        np.testing.assert_array_equal(other.frame(), frame)
        for name, value in other.simulator_state().items():
            np.testing.assert_array_equal(value, state[name])


@pytest.mark.parametrize("task", ["walker_walk", "finger_turn_hard"])
def test_an_episodes_start_depends_on_seed_and_number_alone(task):
    environment, other = small(task), small(task)
    environment.reset()
    for action in random_actions(environment, 7):
        environment.step(action)
    starts = [environment.reset(episode=5).observation, environment.reset().observation]
    np.testing.assert_array_equal(other.reset(episode=5).observation, starts[0])
    assert not np.array_equal(starts[0], starts[1])
    np.testing.assert_array_equal(other.reset().observation, starts[1])
    assert not np.array_equal(small(task, seed=2).reset(5).observation, starts[0])


def test_a_simulator_state_of_another_task_is_refused():
    environment = small()
    environment.reset()
    with pytest.raises(ValueError, match=r"qpos has shape \(9,\).*needs \(2,\)"):
        environment.set_simulator_state(np.zeros(9), np.zeros(2), np.zeros(0))


# --- names and faults -----------------------------------------------------------------


def test_tasks_are_split_at_the_domain():
    for domain, name in dm_suite.ALL_TASKS:
        assert suite.split_task(f"{domain}_{name}") == (domain, name)
    assert suite.split_task("ball_in_cup_catch") == ("ball_in_cup", "catch")
    assert len(suite.known_tasks()) == len(set(suite.known_tasks()))


def test_cameras_are_those_of_drqv2():
    assert suite.camera_of("quadruped_walk") == 2
    assert suite.camera_of("humanoid_CMU_run") == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "cartpole_swing"}, "cartpole_swingup"),
        ({"task": "walker"}, "walker_"),
        ({"task": ""}, "choose one of: acrobot_swingup"),
        ({"render_quality": "best"}, "paper, fast"),
        ({"image_size": 0}, "image_size=0 must be at least 1"),
        ({"action_repeat": 0}, "action_repeat=0 must be at least 1"),
        ({"frame_stack": 0}, "frame_stack=0 must be at least 1"),
        ({"seed": -1}, "seed=-1 must be at least 0"),
        ({"observation": "sound"}, "pixels, state"),
    ],
)
def test_faults_name_value_and_rule(changes, message):
    with pytest.raises(ValueError, match=message):
        small(**changes)
    if "task" not in changes:  # the user's own tasks are checked in the same way
        with pytest.raises(ValueError, match=message):
            make_environment(f"{__name__}:Countdown", **({"seed": 1} | changes))


def test_images_may_be_larger_than_the_models_buffer():
    environment = small(image_size=700, observation="state")
    environment.reset()
    assert environment.frame().shape == (700, 700, 3)


def test_no_gl_is_said_with_a_way_out(monkeypatch):
    from dm_control.mujoco import engine

    def fail(*_, **__):
        raise RuntimeError("No OpenGL rendering backend is available.")

    monkeypatch.setattr(engine, "Camera", fail)
    environment = small()
    with pytest.raises(RuntimeError, match=r"No OpenGL .*jaxil\.doctor"):
        environment.reset()
