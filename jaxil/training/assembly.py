"""From a checked config to a run's environments, replay and demonstrations.

What reads demonstrations raises a DemonstrationError where they do not fit the run.
"""

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from jaxil import config as jaxil_config
from jaxil import methods
from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments import tasks
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.environments.player import InProcess, Player
from jaxil.environments.pool import Pool
from jaxil.environments.suite import known_tasks
from jaxil.environments.tasks import make_environment
from jaxil.errors import Fault, UsageError
from jaxil.machine import memory, screen
from jaxil.machine.progress import shown
from jaxil.native import build
from jaxil.replay.replay import Replay
from jaxil.training import loggers
from jaxil.training.agent import native_fault, stack_size
from jaxil.training.stopwatch import Stopwatch, TimedEnvironments

# Added to the run's seed, so that evaluations do not start as training episodes do.
EVALUATION_SEED = 1_000_003
# Those that `tasks.make_environment` takes.
_ENVIRONMENT_FIELDS = (
    "action_repeat",
    "image_size",
    "frame_stack",
    "render_quality",
    "observation",
    "camera",
    "distraction",
    "max_episode_frames",
)
# With a fault in one of these, the demonstrations are not opened.
_READING_FIELDS = {
    "method",
    "task",
    "demonstrations",
    "image_size",
    "action_repeat",
    "observation",
}


def problems(config: Config) -> list[Fault]:
    """Returns every reason why a config cannot be run here.

    Reads the demonstration file, but renders nothing.
    """
    faults = jaxil_config.problems(config, known_tasks())
    if isinstance(config.logger, str):
        faults += loggers.problems(config.logger)
    bad = {fault.subject.partition(".")[0] for fault in faults}
    if not bad & {"task", "method", *_ENVIRONMENT_FIELDS}:
        checks_length = not bad & {"replay_size_steps", "num_steps"}
        found = task_problems(config, checks_length=checks_length)
        faults += found
        bad |= {fault.subject for fault in found}
    if config.encoder.convolutions == "native" and not bad & {"encoder", "method"}:
        fault = native_fault(config) or build.problem()
        if fault is not None:
            rule = f"is not available: {fault}"
            way_out = "'auto' takes XLA's where it has to"
            faults.append(Fault("encoder.convolutions", rule, way_out, "native"))
    if not bad & _READING_FIELDS and jaxil_config.uses_demonstrations(config):
        fault = demonstration_fault(config)
        if fault is not None:
            source, way_out = config.demonstrations.source, ""
            if not methods.get(config.method).uses_demonstrations:
                setting = "encoder.subtract_mean_image=False"
                way_out = f"only the mean image needs them: {setting}"
            faults.append(Fault(f"demonstrations.source={source!r}:", fault, way_out))
    return faults


def task_problems(config: Config, *, checks_length: bool = False) -> list[Fault]:
    """Returns every reason why the task, or a run of it, cannot be played."""

    def length_problems(steps: int) -> Iterator[Fault]:
        size, n = config.replay_size_steps, config.num_steps
        if checks_length and steps > size:
            rule = f"is less than an episode, which has {steps} agent steps"
            way_out = f"use {steps} or more, or a smaller max_episode_frames"
            yield Fault("replay_size_steps", rule, way_out, size)
        if checks_length and steps < n and methods.get(config.method).plays:
            rule = f"is more than an episode, which has {steps} agent steps"
            way_out = f"use at most {steps}, or nothing is learned"
            yield Fault("num_steps", rule, way_out, n)

    settings = _environment_settings(config)
    return tasks.problems(config.task, length_problems, **settings)


def demonstration_fault(config: Config) -> str | None:
    """Returns why a run cannot use its demonstrations; None if it can."""
    try:
        sees_actions = jaxil_config.sees_actions(config)
        loading.check(sees_actions=sees_actions, **_file_settings(config))
    except DemonstrationError as error:
        return str(error)
    return None


def renderer_name(config: Config, *, films: bool) -> str:
    """Returns what GL calls the device that renders here; "none" if nothing does.

    A run on state vectors has to render only if it `films`.

    Raises:
      UsageError: nothing here can render, but the run needs it.
    """
    with training_environment(config) as environment:
        try:
            return environment.renderer_name()
        except RuntimeError as error:
            if config.observation == "state" and not films:
                return "none"
            way_out = ""
            if config.observation == "state":
                way_out = "; --config.video_every_evals=0 needs no rendering"
            raise UsageError(f"{error}{way_out}") from error


def training_environment(config: Config) -> PixelEnvironment:
    """Returns the environment that gathers experience."""
    return environment_with_seed(config, config.seed)


def evaluation_environment(config: Config) -> PixelEnvironment:
    """Returns a separate environment, with starts that training does not use."""
    return environment_with_seed(config, config.seed + EVALUATION_SEED)


def environment_with_seed(config: Config, seed: int) -> PixelEnvironment:
    """Returns the run's environment with another seed for its resets."""
    return make_environment(config.task, seed=seed, **_environment_settings(config))


def make_player(
    config: Config,
    environment: PixelEnvironment,
    *,
    first_episode: int,
    open_episodes: Mapping[int, np.ndarray],
    stopwatch: Stopwatch,
) -> Player | None:
    """Returns what plays episodes, see `Player`; None for a method that does not play.

    The training environment is the player's from now on: it is closed if there is none,
    or if several are made like it.
    """
    if not methods.get(config.method).plays:
        environment.close()
        return None
    environments: Any = InProcess(environment)
    if config.num_environments > 1:
        # All have one seed: an episode's number alone determines its start. The child
        # imports this without jax, which would take memory and seconds.
        make = functools.partial(
            make_environment,
            config.task,
            seed=config.seed,
            **_environment_settings(config),
        )
        environment.close()
        environments = Pool(make, config.num_environments, say=screen.say)
    return Player(
        TimedEnvironments(environments, stopwatch),
        first_episode=first_episode,
        open_episodes=open_episodes,
    )


def _environment_settings(config: Config) -> dict[str, Any]:
    return {name: config[name] for name in _ENVIRONMENT_FIELDS}


def load_demonstrations(config: Config) -> loading.Demonstrations | None:
    """Returns a run's demonstrations, rendered as the agent sees them; or None.

    Rendering them takes minutes at quality `paper` in software, the first time: a
    progress line is shown.
    """
    if not jaxil_config.uses_demonstrations(config):
        return None
    with shown("rendering the demonstrations, once") as show:
        return loading.load(
            render_quality=config.render_quality,
            camera=config.camera,
            distraction=config.demonstrations.distraction,
            progress=show,
            **_file_settings(config),
        )


def load_shown_expert(
    config: Config, image_size: int, progress: Callable[[int, int], None] | None
) -> loading.Demonstrations:
    """Returns the first demonstration, rendered for people to watch."""
    shown_as = {"image_size": image_size, "observation": "pixels", "num_episodes": 1}
    return loading.load(
        render_quality=config.render_quality,
        camera=config.camera,
        warns=False,  # the run has warned, of the size that the agent sees
        progress=progress,
        **(_file_settings(config) | shown_as),
    )


def expert_return(config: Config) -> float | None:
    """Returns the demonstrations' mean task return; None if unknown."""
    return loading.mean_return(**_file_settings(config))


def _file_settings(config: Config) -> dict[str, Any]:
    """Returns the source and the fields of `loading.Wanted`."""
    settings = config.demonstrations
    usual = jaxil_config.FIELDS["demonstrations.num_episodes"].default
    return {
        "task": config.task,
        "action_repeat": config.action_repeat,
        "max_episode_frames": config.max_episode_frames,
        "image_size": config.image_size,
        "observation": config.observation,
        "source": settings.source,
        "num_episodes": settings.num_episodes,
        "sampling": settings.sampling,
        "fit": settings.fit,
        "frame_skip": settings.frame_skip,
        "takes_fewer": bool(settings.source) and settings.num_episodes == usual,
        "stated_action_repeat": settings.action_repeat,
        "dataset_camera": settings.camera,
        "max_bytes": memory.spare_bytes(),
    }


def make_replay(config: Config, environment: PixelEnvironment) -> Replay:
    """Returns an empty replay of the config's size."""
    environment.reset(episode=0)
    frame = environment.single_observation()
    return Replay(
        capacity_steps=config.replay_size_steps,
        episode_steps=environment.episode_steps,
        observation_shape=frame.shape,
        observation_dtype=frame.dtype,
        action_dim=environment.action_spec().shape[0],
        frame_stack=stack_size(config),
        num_steps=config.num_steps,
        discount_factor=config.discount_factor,
    )
