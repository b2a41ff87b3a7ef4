"""Makes environments of the DeepMind Control Suite.

No other module imports dm_control.
"""

import functools
import hashlib
import importlib
import importlib.metadata
import logging
import os
from collections.abc import Mapping
from typing import Any

import dm_env
import numpy as np

from jaxil.environments.camera import RENDER_QUALITIES, Renderer
from jaxil.environments.distraction import STRENGTHS, Distraction
from jaxil.environments.observations import flat_state
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.errors import unknown_name
from jaxil.machine import startup

OBSERVATIONS = ("pixels", "state")
_missing_gl: list[str] = []  # why the GL backend in MUJOCO_GL is not used


@functools.cache
def _suite() -> Any:
    """Imports dm_control's suite, which chooses the GL backend for good.

    An unavailable backend is replaced by none, since states need no images.
    """
    startup.choose_gl()
    backend = os.environ["MUJOCO_GL"]
    try:
        if backend == "glfw" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
            raise RuntimeError("there is no display")
        from dm_control import suite
    except (ImportError, RuntimeError, AttributeError) as error:
        _missing_gl.append(
            f"MUJOCO_GL={backend} does not work here ({error}): unset it"
        )
        os.environ["MUJOCO_GL"] = "disable"
        from dm_control import suite
    # MuJoCo warns of an attribute in dm_control's own models, which no user can change.
    logging.getLogger("absl").addFilter(
        lambda record: "settotalmass" not in record.getMessage()
    )
    return suite


@functools.cache
def known_tasks() -> tuple[str, ...]:
    """Returns all tasks of the suite as `domain_task`, sorted."""
    return tuple(sorted(f"{domain}_{name}" for domain, name in _suite().ALL_TASKS))


def split_task(task: str) -> tuple[str, str]:
    """Splits "ball_in_cup_catch" into ("ball_in_cup", "catch").

    Raises ValueError for an unknown task, with similar names.
    """
    for domain, name in _suite().ALL_TASKS:
        if task == f"{domain}_{name}":
            return domain, name
    raise ValueError(str(unknown_name("task", task, known_tasks())))


def camera_of(task: str) -> int:
    """Returns the index of the camera that DrQ-v2 uses (dmc.py)."""
    return 2 if task.startswith("quadruped_") else 0


def simulator_versions() -> dict[str, str]:
    """Returns the versions of the packages that determine physics and pixels."""
    return {
        "mujoco": importlib.metadata.version("mujoco"),
        "dm_control": importlib.metadata.version("dm-control"),
    }


class SuiteEnvironment(PixelEnvironment):
    """A task of dm_control, whose states can be stored and rendered later."""

    def __init__(
        self,
        simulator: Any,
        *,
        image_size: int,
        camera: int,
        distraction: str,
        render_quality: str,
        **settings: Any,
    ):
        """Wraps an environment of dm_control, `camera` being an index; see `wrap`."""
        super().__init__(simulator, image_size=image_size, **settings)
        self.renderer = Renderer(
            simulator.physics,
            open_camera=_open_camera,
            image_size=image_size,
            camera=camera,
            render_quality=render_quality,
        )
        self._distraction = None
        if distraction != "none":
            self._distraction = Distraction(simulator.physics, camera, distraction)

    def render(self, image_size: int | None = None) -> np.ndarray:
        """Returns a new image of the agent's size; RuntimeError without usable GL."""
        if image_size not in (None, self.image_size):
            raise ValueError(f"image_size={image_size}: the camera's size is fixed")
        if self._distraction is not None:
            self.renderer.open()
            self._distraction.upload()
        return self.renderer.render()

    def renderer_name(self) -> str:
        """Returns GL's name of the rendering device."""
        return self.renderer.gl_name()

    @property
    def has_mocap_bodies(self) -> bool:
        """Whether something is moved from outside, which files of states lack."""
        return self.physics.model.nmocap > 0

    def simulator_state(self) -> dict[str, np.ndarray]:
        """Returns copies of `qpos`, `qvel` and `act`, each float64 and 1-D.

        With mocap bodies also of `mocap_pos` and `mocap_quat`, float64 and 2-D.
        """
        data = self.physics.data
        mocap = ("mocap_pos", "mocap_quat") if self.has_mocap_bodies else ()
        return {
            name: np.array(getattr(data, name), dtype=np.float64)
            for name in ("qpos", "qvel", "act", *mocap)
        }

    def model_digest(self) -> str:
        """Returns a digest of the compiled model, its colours and shapes included."""
        mujoco: Any = importlib.import_module("mujoco")
        model = self.physics.model.ptr
        content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, content)
        return hashlib.blake2b(content.tobytes(), digest_size=16).hexdigest()

    def set_simulator_state(
        self, qpos: np.ndarray, qvel: np.ndarray, act: np.ndarray, **mocap: np.ndarray
    ) -> None:
        """Sets the simulation to a state from `simulator_state`.

        `frame` and `single_observation` show it at once, the stack after the next step.
        Touch and acceleration sensors, which depend on the previous step's forces, are
        computed without actuation. Raises ValueError for shapes that are not the
        model's.
        """
        data = self.physics.data
        values = {"qpos": qpos, "qvel": qvel, "act": act, **mocap}
        for name, value in values.items():
            given, shape = np.shape(value), getattr(data, name).shape
            if given != shape:
                what = f"{name} has shape {given}"
                raise ValueError(f"{what}, but the task needs {shape}.")
        with self.physics.reset_context():
            for name, value in values.items():
                getattr(data, name)[:] = value
        self._current = None

    @property
    def step_limit(self) -> float:
        """Frames of a whole episode; infinity without a time limit."""
        return self._simulator._step_limit

    @property
    def step_seconds(self) -> float:
        """Simulated duration of an agent step."""
        return self._simulator.control_timestep() * self._action_repeat

    @property
    def physics(self) -> Any:
        """The dm_control `Physics`."""
        return self._simulator.physics

    def close(self) -> None:
        """Frees the simulation and its GL context."""
        self.physics.free()

    def _restart(self, seeds: np.ndarray) -> dm_env.TimeStep:
        self._simulator.task.random.seed(seeds)
        if self._distraction is not None:
            self._distraction.restart(seeds)
        return self._simulator.reset()

    def _state(self) -> np.ndarray:
        # The step's observation would not follow `set_simulator_state`.
        return flat_state(self._simulator.task.get_observation(self.physics))


def make_environment(task: str, **settings: Any) -> SuiteEnvironment:
    """Makes one of `known_tasks()`; `settings` are all of `tasks.make_environment`."""
    random = {"random": settings["seed"]}
    simulator = _suite().load(*split_task(task), task_kwargs=random)
    return wrap(simulator, default_camera=camera_of(task), **settings)


def check_settings(settings: Mapping[str, Any]) -> None:
    """Raises ValueError for an argument of `tasks.make_environment` out of range."""
    lowest = {"seed": 0, "action_repeat": 1, "image_size": 1, "frame_stack": 1}
    for name, least in lowest.items():
        value = settings[name]
        if value < least:
            raise ValueError(f"{name}={value} must be at least {least}.")
    choices = {
        "observation": OBSERVATIONS,
        "render_quality": RENDER_QUALITIES,
        "distraction": STRENGTHS,
    }
    for name, known in choices.items():
        value = settings[name]
        if value not in known:
            names = ", ".join(known)
            raise ValueError(f"{name}={value!r} is unknown; choose one of: {names}.")


def wrap(
    simulator: Any, *, camera: str, default_camera: int = 0, **settings: Any
) -> SuiteEnvironment:
    """Wraps an environment of dm_control; other arguments as for `make_environment`."""
    index = camera_index(simulator.physics.model, camera, default_camera)
    return SuiteEnvironment(simulator, camera=index, **settings)


def camera_index(model: Any, camera: str, default: int = 0) -> int:
    """Returns the index of a camera by its name or number; `default` for "".

    A model without cameras has MuJoCo's free one, of index -1. Raises ValueError if
    there is none like that.
    """
    if not camera:
        return default if model.ncam else -1
    names = [model.id2name(index, "camera") for index in range(model.ncam)]
    numbers = [str(index) for index in range(model.ncam)]
    for known in (names, numbers):
        if camera in known:
            return known.index(camera)
    listed = ", ".join(f"{i} {n}".strip() for i, n in zip(numbers, names))
    raise ValueError(f"camera={camera!r} is unknown; the task has: {listed}.")


def _open_camera(physics: Any, size: int, index: int) -> Any:
    from dm_control.mujoco import engine

    if _missing_gl:
        raise RuntimeError(_missing_gl[0])
    return engine.Camera(physics, height=size, width=size, camera_id=index)
