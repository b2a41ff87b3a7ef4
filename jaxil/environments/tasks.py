"""Makes the environment of any task by its name.

    cartpole_swingup           of the DeepMind Control Suite
    gymnasium:ID               of Gymnasium, with continuous actions
    package.module:function    of the user: returns a dm_env.Environment

A user's environment that is built like the suite's takes every setting that those take;
any other of dm_control, such as composer's, takes a camera but no distraction.
"""

import atexit
import contextlib
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from jaxil import outside
from jaxil.environments import observations, suite
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.errors import Fault, UsageError, raised, unknown_name

LengthProblems = Callable[[int], Iterable[Fault]]

_GYMNASIUM = "gymnasium:"
_RECORDED_SIZE, _LARGEST_RECORDED = 84, 160  # larger images would fill the memory
_LARGEST_RENDERED = 1024


def is_of_suite(task: str) -> bool:
    """Returns whether a name is meant for the control suite."""
    return ":" not in task


def names_code(task: str) -> bool:
    """Returns whether making a task imports a module that its name contains."""
    return ":" in task.removeprefix(_GYMNASIUM)


def problems(
    task: str, length_problems: LengthProblems = lambda steps: (), **settings: Any
) -> list[Fault]:
    """Tries a task: makes it, resets it, takes a step, and looks at it.

    Args:
      task: one of the suite is made at most.
      length_problems: faults of an episode of so many agent steps.
      settings: those of `make_environment`.
    """
    if is_of_suite(task):
        if task not in suite.known_tasks():
            return [unknown_name("task", task, suite.known_tasks())]
        if not settings["camera"]:
            limit = settings["max_episode_frames"]
            return [*length_problems(timing(task, settings["action_repeat"], limit)[1])]
    try:
        with make_environment(task, seed=0, **settings) as environment:
            if not is_of_suite(task):
                environment.reset(episode=0)
                environment.step(np.zeros(environment.action_spec().shape))
                _ = environment.step_seconds
                if settings["observation"] == "pixels":
                    environment.frame()
            return [*length_problems(environment.episode_steps)]
    except UsageError as error:
        return [f if isinstance(f, Fault) else Fault("task", f) for f in error.faults]
    except (Exception, SystemExit) as error:  # whatever the user's task raises
        return [Fault("task", f"cannot be used: {raised(error)}", value=task)]


def make_environment(
    task: str,
    *,
    seed: int,
    action_repeat: int = 2,
    image_size: int = 84,
    frame_stack: int = 3,
    render_quality: str = "paper",
    observation: str = "pixels",
    camera: str = "",
    distraction: str = "none",
    max_episode_frames: int = 0,
) -> PixelEnvironment:
    """Makes the environment of a task.

    Args:
      task: such as "walker_walk", "gymnasium:ID" or "package.module:function".
      seed: determines, with an episode's number, its initial state. At least 0.
      action_repeat: environment frames per agent step.
      image_size: height and width in pixels.
      frame_stack: images per observation; ignored for states.
      render_quality: "paper", "fast" or "smooth"; without effect outside dm_control.
      observation: "pixels" or "state".
      camera: of dm_control alone: its name or index; "" for the one of DrQ-v2.
      distraction: "none", or for tasks built like the suite's "easy", "medium" or
        "hard": how much colours, camera angle and background vary by episode.
      max_episode_frames: longest episode; 0 for the task's limit, or 1000 without one.

    Raises:
      UsageError: there is no such task, a package is missing, or a setting does not
        apply to the task.
      ValueError: a setting is out of range, or the task cannot be used.
    """
    settings: dict[str, Any] = {
        "seed": seed,
        "action_repeat": action_repeat,
        "image_size": image_size,
        "frame_stack": frame_stack,
        "observation": observation,
        "render_quality": render_quality,
        "camera": camera,
        "distraction": distraction,
        "max_episode_frames": max_episode_frames,
    }
    suite.check_settings(settings)
    if is_of_suite(task):
        return suite.make_environment(task, **settings)
    if task.startswith(_GYMNASIUM):
        simulator: Any = _Gymnasium(task.removeprefix(_GYMNASIUM), image_size)
    else:
        simulator = outside.load(task, "task")()
    try:
        return _wrapped(simulator, settings)
    except BaseException:
        with contextlib.suppress(Exception):  # the first error is the one to be told
            simulator.close()
        raise


def _wrapped(simulator: Any, settings: dict[str, Any]) -> PixelEnvironment:
    """Returns the environment of a task outside the suite; consumes `settings`."""
    random = getattr(getattr(simulator, "task", None), "random", None)
    is_like_the_suites = isinstance(random, np.random.RandomState)
    shows_itself = hasattr(simulator, "render") or (
        is_like_the_suites and observations.images_in(simulator.observation_spec())
    )
    if is_like_the_suites and not shows_itself:
        return suite.wrap(simulator, **settings)
    if hasattr(simulator, "physics") and not hasattr(simulator, "render"):
        simulator = _DmControl(simulator, settings["camera"])
        settings["camera"] = ""
    del settings["render_quality"]
    rule = "is for tasks of dm_control's suite"
    for name, without in (("camera", ""), ("distraction", "none")):
        value = settings.pop(name)
        if value != without:
            raise UsageError(Fault(name, rule, value=value))
    return PixelEnvironment(simulator, **settings)


def make_recorded(
    task: str, *, image_size: int | None, **settings: Any
) -> PixelEnvironment:
    """Makes an environment in which a policy is recorded.

    It observes the task's own state vector, or the image where there is none; see
    `make_environment` for the other arguments and the errors.

    Args:
      task: see `make_environment`.
      image_size: of the recorded images. None takes the task's own if they are square
        and at most 160 pixels, else 84. Images that are resized twice, for the file
        and for the agent, differ from the agent's, by which a discriminator could
        tell them.
    """

    def make(side: int) -> PixelEnvironment:
        how = {"image_size": side, **settings}
        try:
            return make_environment(task, observation="state", **how)
        except ValueError:  # it observes images alone
            return make_environment(task, frame_stack=1, **how)

    environment = make(image_size or _RECORDED_SIZE)
    if image_size or is_of_suite(task):
        return environment
    environment.reset(episode=0)
    side = environment.own_image_size
    if side is None or side == _RECORDED_SIZE or side > _LARGEST_RECORDED:
        return environment
    environment.close()
    return make(side)


@functools.cache
def timing(
    task: str, action_repeat: int, max_episode_frames: int = 0
) -> tuple[float | None, int]:
    """Returns an agent step's seconds, None if unknown, and an episode's steps."""
    with make_environment(
        task,
        seed=0,
        image_size=8,
        action_repeat=action_repeat,
        max_episode_frames=max_episode_frames,
    ) as environment:
        return environment.step_seconds, environment.episode_steps


class _DmControl:
    """An environment of dm_control that is not built like the suite's, say composer's.

    It can be seeded if it has a `random_state`, or its task a `random`.
    """

    renders_any_size = True

    def __init__(self, inner: Any, camera: str) -> None:
        self._inner = inner
        self._camera = suite.camera_index(inner.physics.model, camera)
        self.frame_seconds = inner.control_timestep()
        seconds = getattr(inner, "_time_limit", math.inf)
        frames = getattr(inner, "_step_limit", seconds / self.frame_seconds)
        self.step_limit = math.inf if math.isinf(frames) else math.ceil(frames - 1e-6)
        self.reset, self.step, self.close = inner.reset, inner.step, inner.close
        self.action_spec = inner.action_spec
        self.observation_spec = inner.observation_spec

    def seed(self, number: int) -> None:
        of_task = getattr(self._inner.task, "random", None)
        random = getattr(self._inner, "random_state", of_task)
        if random is not None:
            random.seed(number)

    def render(self, side: int) -> np.ndarray:
        physics = self._inner.physics  # composer's is a new one after each reset
        frame = physics.model.vis.global_
        frame.offwidth = max(int(frame.offwidth), _LARGEST_RENDERED)
        frame.offheight = max(int(frame.offheight), _LARGEST_RENDERED)
        return physics.render(side, side, camera_id=self._camera)


class _Gymnasium(dm_env.Environment):
    """An environment of Gymnasium as one of dm_env.

    A termination has discount 0, a truncation 1.
    """

    def __init__(self, name: str, image_size: int) -> None:
        task = _GYMNASIUM + name
        try:
            import gymnasium
        except ImportError as error:
            what = "needs Gymnasium, which is not installed"
            way_out = "in jaxil's folder: pip install '.[gymnasium]'"
            raise UsageError(Fault("task", what, way_out, task)) from error
        make = functools.partial(
            gymnasium.make, name, render_mode="rgb_array", disable_env_checker=True
        )
        try:
            self._inner = make()
            # MuJoCo's render at any size. To others these words may mean anything.
            if hasattr(self._inner.unwrapped, "mujoco_renderer"):
                self._inner.close()
                self._inner = make(width=image_size, height=image_size)
        except (gymnasium.error.Error, ImportError) as error:
            what = f"cannot be made: {error}"
            raise UsageError(Fault("task", what, value=task)) from error
        space: Any = self._inner.action_space
        if not isinstance(space, gymnasium.spaces.Box):
            needed = "a vector of numbers (Box)"
            raise ValueError(f"has actions {space}, but needs {needed}")
        self._space = space
        spec, inner = self._inner.spec, self._inner.unwrapped
        self.step_limit = spec and spec.max_episode_steps
        rate = inner.metadata.get("render_fps") or None
        self.frame_seconds = getattr(inner, "dt", None) or (rate and 1.0 / rate)
        self._next_seed: int | None = None
        self._is_rendered = False

    def seed(self, number: int) -> None:
        self._next_seed = number

    def reset(self) -> dm_env.TimeStep:
        observation, _ = self._inner.reset(seed=self._next_seed)
        return dm_env.restart(observation)

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        action = np.clip(action, self._space.low, self._space.high)
        observation, reward, terminated, truncated, _ = self._inner.step(
            action.astype(self._space.dtype)
        )
        if terminated:
            return dm_env.termination(float(reward), observation)
        if truncated:
            return dm_env.truncation(float(reward), observation)
        return dm_env.transition(float(reward), observation)

    def render(self) -> Any:
        self._enter_context()
        image = self._inner.render()
        if not self._is_rendered:
            # The GL library is open by now, so this runs before its own exit handler.
            atexit.register(self.close)
            self._is_rendered = True
        return image

    def action_spec(self) -> specs.BoundedArray:  # pyright: ignore
        space = self._space
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high)

    def observation_spec(self) -> Any:
        return _spec_of(self._inner.observation_space)

    def close(self) -> None:
        atexit.unregister(self.close)
        viewer = self._enter_context()
        if viewer is not None:  # else its buffers are freed in another's context
            viewer.con.free()
        self._inner.close()

    def _enter_context(self) -> Any:
        """Makes MuJoCo's GL context the current one, and returns its owner or None.

        Gymnasium does so at creation alone: several environments would render black
        images, or into each other's buffers.
        """
        renderer = getattr(self._inner.unwrapped, "mujoco_renderer", None)
        viewer = getattr(renderer, "viewer", None)
        if viewer is not None:
            viewer.make_context_current()
        return viewer


def _spec_of(space: Any) -> Any:
    """Returns the spec of a Box, of a dictionary of them, or of anything else."""
    if hasattr(space, "spaces") and hasattr(space.spaces, "items"):
        return {name: _spec_of(part) for name, part in space.spaces.items()}
    return specs.Array(space.shape or (), space.dtype or np.float32)
