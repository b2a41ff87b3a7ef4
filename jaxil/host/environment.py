"""DeepMind Control tasks as an agent sees them: stacked camera frames.

The only module that knows dm_control. `jaxil.platform.prepare` has to run before
it is used: the GL backend is chosen when dm_control is first imported.
"""

import collections
import difflib
import functools
import importlib.metadata
import math
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

RENDER_QUALITIES = ("paper", "fast", "smooth")
OBSERVATIONS = ("pixels", "state")
# Tasks whose camera 0 does not follow the body: DrQ-v2 looks through another one.
_CAMERAS = {"quadruped": 2}
# Shadow maps and four-fold supersampling are most of a software renderer's work.
_FAST_FLAGS = {"shadow": False, "reflection": False}
# "smooth" draws this many times larger and averages: without it, a thin pole jumps
# from pixel to pixel, and nothing in a small image shows how fast it turns.
_SMOOTH_FACTOR = 2
_SEED_WORDS = 8
# MuJoCo's stand-in for "no bound" on an actuator; no sensible range to rescale to.
_UNBOUNDED = 1e9


@functools.cache
def known_tasks() -> tuple[str, ...]:
    """Returns all tasks of the control suite, as `domain_task`, sorted."""
    from dm_control import suite

    return tuple(sorted(f"{domain}_{name}" for domain, name in suite.ALL_TASKS))


def split_task(task: str) -> tuple[str, str]:
    """Splits "ball_in_cup_catch" into ("ball_in_cup", "catch").

    Raises:
      ValueError: no such task; names the closest ones.
    """
    from dm_control import suite

    for domain, name in suite.ALL_TASKS:
        if task == f"{domain}_{name}":
            return domain, name
    close = difflib.get_close_matches(task, known_tasks(), n=3, cutoff=0.5)
    same_domain = [known for known in known_tasks() if known.startswith(task)]
    advice = close or same_domain[:3] or ["cartpole_swingup", "walker_walk"]
    raise ValueError(
        f"task={task!r} is not a task of the control suite; write domain_task, "
        f"such as {', '.join(advice)}."
    )


def camera_of(task: str) -> int:
    """Returns the index of the camera that the field uses for `task`.

    Source: github.com/facebookresearch/drqv2, dmc.py: 2 for quadruped, else 0.
    """
    return _CAMERAS.get(split_task(task)[0], 0)


@functools.cache
def decision_seconds(task: str, action_repeat: int) -> float:
    """Returns the simulated time between two decisions of the agent, in seconds."""
    from dm_control import suite

    return suite.load(*split_task(task)).control_timestep() * action_repeat


def simulator_versions() -> dict[str, str]:
    """Returns the versions of the packages that physics and pixels depend on."""
    return {
        "mujoco": importlib.metadata.version("mujoco"),
        "dm_control": importlib.metadata.version("dm-control"),
    }


class Renderer:
    """One camera on one simulation, kept for as long as the simulation lives.

    dm_control's own `physics.render` builds camera and scene anew for each image,
    which in software takes longer than drawing.
    """

    def __init__(
        self, physics: Any, *, image_size: int, camera: int, render_quality: str
    ):
        """Prepares to draw; the GL context is made at the first image.

        Args:
          physics: a dm_control `Physics` that has not been rendered yet.
          image_size: height and width in pixels.
          camera: index of a camera of the model.
          render_quality: "paper" for dm_control's defaults, "fast" for neither
            supersampling nor shadows nor reflections, "smooth" for "fast" at twice
            the size, averaged over 2x2 pixels.

        Raises:
          ValueError: unknown quality, no such camera, or a size below one.
        """
        if render_quality not in RENDER_QUALITIES:
            raise ValueError(
                f"render_quality={render_quality!r} is unknown; choose one of: "
                f"{', '.join(RENDER_QUALITIES)}."
            )
        if image_size < 1:
            raise ValueError(f"image_size={image_size} must be at least 1 pixel.")
        num_cameras = int(physics.model.ncam)
        if not 0 <= camera < num_cameras:
            raise ValueError(
                f"camera={camera} does not exist: the model has {num_cameras}, "
                f"numbered from 0."
            )
        self._physics = physics
        self.image_size = image_size
        self._camera_index = camera
        self._flags = None if render_quality == "paper" else _FAST_FLAGS
        self._factor = _SMOOTH_FACTOR if render_quality == "smooth" else 1
        self._camera = None
        vis = physics.model.vis
        # Both are read when the GL context is made, so they must be set before.
        if render_quality != "paper":
            vis.quality.offsamples = 0
            # Spheres of fewer triangles: half or less of the time, 0.1 to 0.2 grey
            # levels of mean difference at 48x48.
            vis.quality.numslices, vis.quality.numstacks = 12, 8
        drawn_size = self._factor * image_size
        vis.global_.offwidth = max(int(vis.global_.offwidth), drawn_size)
        vis.global_.offheight = max(int(vis.global_.offheight), drawn_size)

    def render(self) -> np.ndarray:
        """Draws the simulation as it stands. uint8 [H, W, 3], the caller's to keep.

        Raises:
          RuntimeError: this machine has no usable GL.
        """
        image = self._open().render(render_flag_overrides=self._flags)
        if self._factor == 1:
            # The camera hands out its one buffer, overwritten by the next image.
            return image.copy()
        n = self._factor
        total = np.full((self.image_size, self.image_size, 3), n * n // 2, np.uint16)
        for i, j in np.ndindex(n, n):
            total += image[i::n, j::n]
        return (total // (n * n)).astype(np.uint8)

    def gl_name(self) -> str:
        """Returns what GL calls the device that draws, such as "llvmpipe (...)"."""
        self._open()
        from OpenGL import GL

        def name() -> str:
            raw = GL.glGetString(GL.GL_RENDERER)
            return raw.decode() if isinstance(raw, bytes) else str(raw)

        with self._physics.contexts.gl.make_current() as context:
            return str(context.call(name))

    def _open(self) -> Any:
        if self._camera is None:
            from dm_control.mujoco import engine

            try:
                self._camera = engine.Camera(
                    self._physics,
                    height=self._factor * self.image_size,
                    width=self._factor * self.image_size,
                    camera_id=self._camera_index,
                )
            except (RuntimeError, ImportError) as error:
                raise RuntimeError(
                    f"nothing here can render: {error} "
                    "`python -m jaxil.doctor` says what to install."
                ) from error
        return self._camera


class PixelEnvironment(dm_env.Environment):
    """A suite task seen through its camera.

    Time runs in agent steps, each of `action_repeat` environment frames. The last
    `frame_stack` images form one observation, uint8 [H, W, 3 * frame_stack], oldest
    first; at a reset the first image stands for the missing ones. With
    `observation="state"` it is the suite's own observation instead, flattened, of
    one time only, float32 [S], and nothing is rendered unless asked for.
    """

    def __init__(
        self,
        suite_environment: Any,
        *,
        task: str,
        seed: int,
        action_repeat: int,
        frame_stack: int,
        observation: str,
        renderer: Renderer,
    ):
        """Wraps `suite_environment`; see `make_environment` for the arguments."""
        self._suite_environment = suite_environment
        self._name = task
        self._seed = seed
        self._action_repeat = action_repeat
        self._renders = observation == "pixels"
        self._renderer = renderer
        self._num_episodes_started = 0
        self._reset_next_step = True
        self._current: np.ndarray | None = None  # drawn or read at the present time
        self._frames: collections.deque[np.ndarray] = collections.deque(
            maxlen=frame_stack
        )
        bounds = suite_environment.action_spec()
        bounded = np.abs(bounds.maximum) < _UNBOUNDED
        self._action_low = np.where(bounded, bounds.minimum, -1.0)
        self._action_half_range = (
            np.where(bounded, bounds.maximum, 1.0) - self._action_low
        ) / 2.0
        self._action_spec = specs.BoundedArray(
            shape=bounds.shape,
            dtype=np.float32,
            minimum=np.float32(-1.0),
            maximum=np.float32(1.0),
            name="action",
        )
        if self._renders:
            size = renderer.image_size
            self._observation_spec: specs.Array = specs.BoundedArray(
                shape=(size, size, 3 * frame_stack),
                dtype=np.uint8,
                minimum=0,
                maximum=255,
                name="observation",
            )
        else:
            parts = suite_environment.observation_spec().values()
            state_dim = sum(math.prod(part.shape) for part in parts)
            self._observation_spec = specs.Array(
                shape=(state_dim,), dtype=np.float32, name="observation"
            )

    def reset(self, episode: int | None = None) -> dm_env.TimeStep:
        """Starts an episode.

        Args:
          episode: number of the episode, from 0: together with the seed it fixes
            the start, whatever was played before. None takes the number after the
            last one played.
        """
        if episode is None:
            episode = self._num_episodes_started
        if episode < 0:
            raise ValueError(f"episode={episode} must not be negative.")
        words = np.random.SeedSequence([self._seed, episode]).generate_state(
            _SEED_WORDS
        )
        self._suite_environment.task.random.seed(words)
        self._suite_environment.reset()
        self._num_episodes_started = episode + 1
        self._reset_next_step = False
        self._current = None
        self._frames.clear()
        return dm_env.restart(self._observe())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Applies `action` for one agent step, or resets after an episode's end.

        Args:
          action: Shape [A], in [-1, 1].

        Returns:
          The time step: rewards of the repeats summed, discounts multiplied. The
          discount stays 1 where a time limit ends the episode.

        Raises:
          ValueError: `action` has another shape.
        """
        if self._reset_next_step:
            return self.reset()
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self._action_spec.shape:
            raise ValueError(
                f"action has shape {action.shape}, expected {self._action_spec.shape}."
            )
        control = self._action_low + (action + 1.0) * self._action_half_range
        reward, discount, is_last = 0.0, 1.0, False
        for _ in range(self._action_repeat):
            inner = self._suite_environment.step(control)
            reward += float(inner.reward)
            discount *= float(inner.discount)
            is_last = inner.last()
            if is_last:
                break
        self._reset_next_step = is_last
        self._current = None
        kind = dm_env.StepType.LAST if is_last else dm_env.StepType.MID
        return dm_env.TimeStep(kind, reward, discount, self._observe())

    def action_spec(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> specs.BoundedArray:
        """Returns the spec of actions: float32 [A] in [-1, 1]."""
        return self._action_spec

    def observation_spec(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> specs.Array:
        """Returns the spec of stacked pixels, or of the state vector."""
        return self._observation_spec

    def single_observation(self) -> np.ndarray:
        """Returns the present alone: uint8 [H, W, 3], or float32 [S] in state mode.

        It is what a replay stores for one time. After `set_simulator_state` it
        shows the state that was set.
        """
        if self._current is None:
            self._current = self._renderer.render() if self._renders else self._state()
        return self._current.copy()

    def frame(self) -> np.ndarray:
        """Returns the present image, uint8 [H, W, 3]; in state mode it is drawn now."""
        return self.single_observation() if self._renders else self._renderer.render()

    def simulator_state(self) -> dict[str, np.ndarray]:
        """Returns copies of `qpos`, `qvel` and `act`, each float64 and 1-D."""
        data = self.physics.data
        return {
            name: np.array(getattr(data, name), dtype=np.float64)
            for name in ("qpos", "qvel", "act")
        }

    def set_simulator_state(
        self, qpos: np.ndarray, qvel: np.ndarray, act: np.ndarray
    ) -> None:
        """Puts the simulation into a state from `simulator_state`.

        `frame` and `single_observation` show it at once; the stack keeps its images
        until the next step. Touch and acceleration sensors, which depend on the
        forces of the step before, are those of the state at rest from actuation.

        Raises:
          ValueError: an array has another shape than the model's.
        """
        data = self.physics.data
        values = {"qpos": qpos, "qvel": qvel, "act": act}
        for name, value in values.items():
            shape = getattr(data, name).shape
            if np.shape(value) != shape:
                raise ValueError(
                    f"{name} has shape {np.shape(value)}, but {self._name} "
                    f"needs {shape}."
                )
        with self.physics.reset_context():
            for name, value in values.items():
                getattr(data, name)[:] = value
        self._current = None

    @property
    def episode_steps(self) -> int | None:
        """Agent steps of a whole episode; None where only the task ends it."""
        limit = self._suite_environment._step_limit
        return None if math.isinf(limit) else math.ceil(limit / self._action_repeat)

    @property
    def num_episodes_started(self) -> int:
        """The number that `reset()` will give to the next episode."""
        return self._num_episodes_started

    @property
    def physics(self) -> Any:
        """The dm_control `Physics`."""
        return self._suite_environment.physics

    @property
    def renderer(self) -> Renderer:
        """What draws this environment's images."""
        return self._renderer

    def close(self) -> None:
        """Frees the simulation and its GL context."""
        self.physics.free()

    def _state(self) -> np.ndarray:
        values = self._suite_environment.task.get_observation(self.physics).values()
        flat = [np.ravel(value) for value in values]
        return np.concatenate(flat).astype(np.float32)

    def _observe(self) -> np.ndarray:
        single = self.single_observation()
        if not self._renders:
            return single
        if not self._frames:
            self._frames.extend([single] * (self._frames.maxlen or 1))
        else:
            self._frames.append(single)
        return np.concatenate(self._frames, axis=2)


def make_environment(
    task: str,
    *,
    seed: int,
    action_repeat: int = 2,
    image_size: int = 84,
    frame_stack: int = 3,
    render_quality: str = "paper",
    observation: str = "pixels",
    camera: int | None = None,
) -> PixelEnvironment:
    """Makes the environment of `task`.

    Args:
      task: `domain_task`, one of `known_tasks()`.
      seed: with an episode's number it fixes the episode's start. At least 0.
      action_repeat: environment frames per agent step.
      image_size: height and width in pixels.
      frame_stack: images per observation; without effect on states.
      render_quality: "paper", "fast" or "smooth".
      observation: "pixels" or "state".
      camera: index of the camera; None takes the field's choice, `camera_of(task)`.

    Raises:
      ValueError: an argument is out of range.
    """
    for name, value, least in (
        ("seed", seed, 0),
        ("action_repeat", action_repeat, 1),
        ("frame_stack", frame_stack, 1),
    ):
        if value < least:
            raise ValueError(f"{name}={value} must be at least {least}.")
    if observation not in OBSERVATIONS:
        raise ValueError(
            f"observation={observation!r} is unknown; choose one of: "
            f"{', '.join(OBSERVATIONS)}."
        )
    from dm_control import suite

    domain, name = split_task(task)
    suite_environment = suite.load(domain, name, task_kwargs={"random": seed})
    renderer = Renderer(
        suite_environment.physics,
        image_size=image_size,
        camera=camera_of(task) if camera is None else camera,
        render_quality=render_quality,
    )
    return PixelEnvironment(
        suite_environment,
        task=task,
        seed=seed,
        action_repeat=action_repeat,
        frame_stack=frame_stack,
        observation=observation,
        renderer=renderer,
    )
