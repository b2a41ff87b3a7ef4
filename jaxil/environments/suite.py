"""Makes environments of the DeepMind Control Suite.

No other module imports dm_control.
"""

import difflib
import functools
import importlib.metadata
import os
from typing import Any

from jaxil.environments.camera import RENDER_QUALITIES, Renderer
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.machine import startup

OBSERVATIONS = ("pixels", "state")


@functools.cache
def _suite() -> Any:
    """Imports dm_control's suite, which chooses the GL backend for good.

    A backend that is not available is replaced by none, since states need no images.
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
    return suite


# Why the backend that the user chose is not used.
_missing_gl: list[str] = []


@functools.cache
def known_tasks() -> tuple[str, ...]:
    """Returns all tasks of the suite as `domain_task`, sorted."""
    return tuple(sorted(f"{domain}_{name}" for domain, name in _suite().ALL_TASKS))


def split_task(task: str) -> tuple[str, str]:
    """Splits "ball_in_cup_catch" into ("ball_in_cup", "catch").

    Raises:
      ValueError: unknown task; names similar ones.
    """
    for domain, name in _suite().ALL_TASKS:
        if task == f"{domain}_{name}":
            return domain, name
    close = difflib.get_close_matches(task, known_tasks(), n=3, cutoff=0.5)
    same_domain = [known for known in known_tasks() if known.startswith(task)]
    advice = close or same_domain[:3] or ["cartpole_swingup", "walker_walk"]
    raise ValueError(
        f"task={task!r} is not a task of the control suite; write domain_task, "
        f"for example {', '.join(advice)}."
    )


def camera_of(task: str) -> int:
    """Returns the index of the camera that DrQ-v2 uses (dmc.py)."""
    return 2 if split_task(task)[0] == "quadruped" else 0


@functools.cache
def decision_seconds(task: str, action_repeat: int) -> float:
    """Returns the simulated duration of an agent step, in seconds."""
    return _suite().load(*split_task(task)).control_timestep() * action_repeat


def simulator_versions() -> dict[str, str]:
    """Returns the versions of the packages that determine physics and pixels."""
    return {
        "mujoco": importlib.metadata.version("mujoco"),
        "dm_control": importlib.metadata.version("dm-control"),
    }


def make_environment(
    task: str,
    *,
    seed: int,
    action_repeat: int = 2,
    image_size: int = 84,
    frame_stack: int = 3,
    render_quality: str = "paper",
    observation: str = "pixels",
) -> PixelEnvironment:
    """Makes the environment of `task`.

    Args:
      task: one of `known_tasks()`.
      seed: determines, with an episode's number, its initial state. At least 0.
      action_repeat: environment frames per agent step.
      image_size: height and width in pixels.
      frame_stack: images per observation; ignored for states.
      render_quality: "paper", "fast" or "smooth".
      observation: "pixels" or "state".
    """
    for name, value, least in (
        ("seed", seed, 0),
        ("action_repeat", action_repeat, 1),
        ("image_size", image_size, 1),
        ("frame_stack", frame_stack, 1),
    ):
        if value < least:
            raise ValueError(f"{name}={value} must be at least {least}.")
    for name, value, known in (
        ("observation", observation, OBSERVATIONS),
        ("render_quality", render_quality, RENDER_QUALITIES),
    ):
        if value not in known:
            names = ", ".join(known)
            raise ValueError(f"{name}={value!r} is unknown; choose one of: {names}.")
    domain, name = split_task(task)
    suite_environment = _suite().load(domain, name, task_kwargs={"random": seed})
    renderer = Renderer(
        suite_environment.physics,
        open_camera=_open_camera,
        image_size=image_size,
        camera=camera_of(task),
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


def _open_camera(physics: Any, size: int, index: int) -> Any:
    from dm_control.mujoco import engine

    if _missing_gl:
        raise RuntimeError(_missing_gl[0])
    return engine.Camera(physics, height=size, width=size, camera_id=index)
