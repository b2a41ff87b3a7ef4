"""Makes environments of the DeepMind Control Suite.

The only module that knows dm_control. Call `jaxil.machine.startup.prepare` first: the
GL backend is chosen when dm_control is imported.
"""

import difflib
import functools
import importlib.metadata
from typing import Any

from jaxil.environments.camera import Renderer
from jaxil.environments.pixel_environment import PixelEnvironment

OBSERVATIONS = ("pixels", "state")
# Where camera 0 does not follow the body, DrQ-v2 takes another one.
_CAMERAS = {"quadruped": 2}


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
      seed: with an episode's number it fixes the episode's start. At least 0.
      action_repeat: environment frames per agent step.
      image_size: height and width in pixels.
      frame_stack: images per observation; without effect on states.
      render_quality: "paper", "fast" or "smooth".
      observation: "pixels" or "state".

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

    return engine.Camera(physics, height=size, width=size, camera_id=index)
