"""All settings with their defaults and rules, and the one place where they are checked.

Durations end in their unit: `_frames` are environment frames, before action repeat;
`_steps` are agent steps. Fields of a single method stand beside its rewarder
(see `jaxil.methods`).
"""

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import ml_collections

from jaxil import declarations, methods, outside
from jaxil.declarations import Field
from jaxil.demonstrations.settings import DEMONSTRATIONS
from jaxil.errors import Fault, UsageError, collecting, unknown_name

# An ml_collections.ConfigDict, whose fields no type checker can know.
Config = Any

# The paper's budgets, in environment frames; other tasks get the larger one.
_EASY_TASKS = ("cartpole_swingup", "finger_spin", "ball_in_cup_catch")
_EASY_FRAMES, _HARD_FRAMES = 1_500_000, 5_000_000

FIELDS: dict[str, Field] = {
    "method": Field("pdac", "a method's name, or package.module:METHOD"),
    "task": Field(
        "cartpole_swingup",
        "of the DeepMind Control Suite; or gymnasium:ID; or package.module:function, "
        "which returns a dm_env.Environment",
    ),
    "seed": Field(0, "seeds NumPy and JAX", 0, 2**31 - 1),
    # What the agent sees and does.
    "observation": Field(
        "pixels", "state: the simulator's, for experts", choices=("pixels", "state")
    ),
    "action_repeat": Field(2, "frames of one agent step; 2 in the paper", 1, 100),
    "image_size": Field(84, "pixels of a side; 84 in the paper", 8, 1024),
    "frame_stack": Field(3, "frames of one observation; 3 in the paper", 1, 16),
    "render_quality": Field(
        "paper",
        "paper: dm_control's; fast: no shadows; smooth: fast, from twice the size",
        choices=("paper", "fast", "smooth"),
    ),
    "camera": Field("", "its name or number in the task; empty: DrQ-v2's"),
    "distraction": Field(
        "none",
        "random colours, camera angle and background in each of the agent's episodes",
        choices=("none", "easy", "medium", "hard"),
    ),
    "max_episode_frames": Field(
        0, "longest episode; 0: the task's own, or 1000 without one", 0, 10**8
    ),
    "total_frames": Field(_EASY_FRAMES, "length of the run", 1, 10**10),
    # Replay and schedule.
    "replay_size_steps": Field(
        150_000,
        "stored agent steps, which bounds how old a stored reward is; it must hold "
        "whole episodes; 150000 in the paper",
        1_000,
        10**8,
    ),
    "reward_refresh_steps": Field(
        0,
        "agent steps between two recomputations of all stored rewards, at an episode's "
        "end; 0, as in the paper: episodes keep their first rewards. Without effect "
        "if a method's rewards never change",
        0,
        10**9,
    ),
    "batch_size": Field(256, "256 in the paper", 1, 65_536),
    "num_steps": Field(3, "n of n-step returns; 3 in the paper, 1 on walkers", 1, 100),
    "discount_factor": Field(0.99, "gamma; 0.99 in the paper", 0.0, 1.0),
    # The paper's table gives 2000 and 4000 for these two; DrQ-v2 and ROT, its source,
    # have 4000 frames before the first update and 2000 steps of uniform actions.
    "seed_frames": Field(4_000, "before the first update; 4000 in DrQ-v2", 1, 10**9),
    "exploration_steps": Field(2_000, "of uniform actions; 2000 in DrQ-v2", 0, 10**9),
    "update_every_steps": Field(2, "agent steps per update; 2 in the paper", 1, 10**6),
    "updates_per_step": Field(1, "updates whenever due; 1 in the paper", 1, 100),
    "learning_rate": Field(
        1e-4, "of each network's Adam; 1e-4 in the paper", 0, 1, positive=True
    ),
    "learning_rate_end": Field(
        0.0, "after learning_rate_steps", 0, 1, at_most="learning_rate"
    ),
    "learning_rate_steps": Field(
        0, "agent steps from learning_rate to learning_rate_end; 0: constant", 0, 10**9
    ),
    "feature_dim": Field(50, "width of the trunks; 50 in the paper", 1, 10**5),
    "hidden_dim": Field(1024, "of actor and critic; 1024 in the paper", 1, 10**5),
    "critic_target_tau": Field(
        0.01, "update rate of the target critic; 0.01 in DrQ-v2", 0, 1, positive=True
    ),
    "policy_tau": Field(
        1.0,
        "weight of the newest policy in the evaluated average; 1: no averaging",
        0,
        1,
        positive=True,
    ),
    "noise_clip": Field(0.3, "bound on noise in updates; 0.3 in DrQ-v2", 0.0, 2.0),
    "exploration_std_start": Field(1.0, "initial std; 1 in the paper", 0.0, 10.0),
    "exploration_std_end": Field(
        0.1, "final std; 0.1 in the paper", 0.0, 10.0, at_most="exploration_std_start"
    ),
    "exploration_std_steps": Field(
        500_000, "agent steps from start to end; 500000 in the paper", 1, 10**9
    ),
    "shift_padding": Field(
        4, "pixels of the random shift; 4 in the paper, 0 for no augmentation", 0, 512
    ),
    "pre_tanh_penalty": Field(
        0.0, "weight of the actor-saturation penalty; 0 in the paper", 0.0, 1e3
    ),
    "encoder.channels": Field((32, 32, 32, 32), "of each convolution"),
    "encoder.kernel_sizes": Field((3, 3, 3, 3), "of each convolution"),
    "encoder.strides": Field((2, 1, 1, 1), "of each convolution"),
    "encoder.contrast": Field(1.0, "factor on pixels; 1 in the paper", 1e-6, 1e6),
    "encoder.subtract_mean_image": Field(
        False, "subtracts the demonstrations' mean image, not 0.5"
    ),
    "encoder.convolutions": Field(
        "auto",
        "native: the encoder in C, for CPUs with GCC, float32 and channels in 32s; "
        "auto: native where possible; see `jaxil.native.build`",
        choices=("auto", "native", "xla"),
    ),
    **{f"demonstrations.{name}": field for name, field in DEMONSTRATIONS.items()},
    # Speed.
    "replay_on_device": Field(
        False, "keeps a copy of the replay's frames on the device; only speed changes"
    ),
    "updates_per_dispatch": Field(
        1, "updates per device call; the policy lags by up to N - 1 of them", 1, 1_000
    ),
    "num_environments": Field(
        1, "in parallel processes; the policy lags by up to N - 1 steps", 1, 64
    ),
    "compute_dtype": Field(
        "float32", "of convolutions and trunks", choices=("float32", "bfloat16")
    ),
    # Evaluation and logging.
    "eval_every_frames": Field(
        10_000, "between two evaluations; 10000 in DrQ-v2", 1, 10**10
    ),
    "num_eval_episodes": Field(10, "per evaluation; 10 in DrQ-v2", 1, 10**4),
    "checkpoint_every_frames": Field(10_000, "most a kill can lose", 1, 10**10),
    "video_every_evals": Field(5, "0 turns videos off", 0, 10**6),
    "logger": Field(
        "", "in addition to CSV and TensorBoard: wandb, or package.module:function"
    ),
}
# Fields that do not affect what is learned: they may differ between the seeds of one
# experiment, and change when a run is resumed.
FREE_FIELDS = (
    "total_frames",
    "encoder.convolutions",
    "replay_on_device",
    "eval_every_frames",
    "num_eval_episodes",
    "checkpoint_every_frames",
    "video_every_evals",
    "logger",
)
# Durations that must be whole agent steps.
_WHOLE_STEPS = (
    "total_frames",
    "seed_frames",
    "eval_every_frames",
    "checkpoint_every_frames",
)


def default_config(method: str = "pdac", task: str = "cartpole_swingup") -> Config:
    """Returns the paper's settings for a method on a task that the user names.

    Raises:
      UsageError: there is no such method, or a section of it is one of every config.
    """
    outside.trust(task)
    return defaults(method, task)


def defaults(method: str, task: str) -> Config:
    """Returns `default_config` for a task that a file names, which is not trusted."""
    declared = methods.get(method)
    taken = {name.partition(".")[0] for name in FIELDS} & set(declared.sections)
    if taken:
        rule = f"has sections that every config has ({', '.join(sorted(taken))})"
        raise UsageError(Fault("method", rule, "rename them", method))
    limits = {f.at_most for group in declared.sections.values() for f in group.values()}
    numbers = {name for name, f in FIELDS.items() if type(f.default) in (int, float)}
    if unknown := limits - numbers - {""}:
        rule = f"has at_most={unknown.pop()!r}, which is no number of every config"
        raise UsageError(Fault("method", rule, "name one, such as batch_size", method))
    config: Config = ml_collections.ConfigDict()
    for name, field in fields(method).items():
        group, _, leaf = name.rpartition(".")
        if group and group not in config:
            config[group] = ml_collections.ConfigDict()
        (config[group] if group else config)[leaf] = field.default
    config.method, config.task = method, task
    config.total_frames = _EASY_FRAMES if task in _EASY_TASKS else _HARD_FRAMES
    config.num_steps = 1 if task.startswith("walker") else 3
    if not declared.plays:
        config.total_frames = frames_of_updates(config)
    return config


def frames_of_updates(config: Config) -> int:
    """Returns the length of a run of a method that does not play."""
    total_updates = methods.get(config.method).total_updates
    times = -(-total_updates // config.updates_per_step)
    return times * config.update_every_steps * config.action_repeat


def fields(method: str) -> dict[str, Field]:
    """Returns all fields of a method's config by dotted name, in order."""
    own = {
        f"{section}.{name}": field
        for section, members in methods.get(method).sections.items()
        for name, field in members.items()
    }
    return {**FIELDS, **own}


def read(config: Config, field: str) -> Any:
    """Returns a field by its dotted name."""
    return functools.reduce(lambda value, part: value[part], field.split("."), config)


def uses_demonstrations(config: Config) -> bool:
    """Returns whether a run of this config reads demonstrations."""
    uses = methods.get(config.method).uses_demonstrations
    return uses or config.encoder.subtract_mean_image


def sees_actions(config: Config) -> bool:
    """Returns whether the method reads the expert's actions."""
    sees = methods.get(config.method).sees_actions
    return read(config, sees) if isinstance(sees, str) else sees


def problems(config: Config, known_tasks: tuple[str, ...]) -> list[Fault]:
    """Checks every field; of tasks, only those of the control suite."""
    faults, known, method = [], FIELDS, None
    if isinstance(config.method, str):  # a ConfigDict takes None for any type
        with collecting(faults):
            known, method = fields(config.method), methods.get(config.method)
    faults += _problems(config, known, known_tasks)
    if method and method.needs_pixels and config.observation == "state":
        rule = f"has no image, which {method.label} judges"
        faults.append(Fault("observation", rule, "use 'pixels'", "state"))
    return faults


def _problems(
    config: Config, known: Mapping[str, Field], known_tasks: tuple[str, ...]
) -> Iterator[Fault]:
    task = config.task
    if isinstance(task, str) and ":" not in task and task not in known_tasks:
        yield unknown_name("task", task, known_tasks)
    bad = set()
    for name, field in known.items():
        value = read(config, name)
        for fault in declarations.field_problems(name, field, value):
            bad.add(name)
            yield fault
    for name in _WHOLE_STEPS:
        value, repeat = read(config, name), config.action_repeat
        if not {name, "action_repeat"} & bad and value % repeat:
            nearest = max(round(value / repeat), 1) * repeat
            rule = f"is not a multiple of action_repeat={repeat}"
            why = "so it ends inside an agent step"
            yield Fault(name, f"{rule}, {why}", f"use {nearest}", value)
    for name, field in known.items():
        limit = field.at_most
        if limit and not {name, limit} & bad:
            value, most = read(config, name), read(config, limit)
            if value > most:
                rule = f"is above {limit}={most}"
                yield Fault(name, rule, f"use at most {most}", value)
    if config.observation == "state" and config.encoder.subtract_mean_image:
        rule = "needs observation='pixels', since a state vector has no mean image"
        yield Fault("encoder.subtract_mean_image", rule, "set it to False", True)
    if not any(name.startswith("encoder.") for name in bad):
        yield from _encoder_problems(config)


def _encoder_problems(config: Config) -> Iterator[Fault]:
    settings = config.encoder
    layers = {name: settings[name] for name in ("channels", "kernel_sizes", "strides")}
    lengths = {name: len(values) for name, values in layers.items()}
    if len(set(lengths.values())) != 1:
        rule = f"has lists whose lengths differ ({lengths})"
        way_out = "give channels, kernel_sizes and strides one entry per layer"
        yield Fault("encoder", rule, way_out)
        return
    for name, values in layers.items():
        if not values or any(not isinstance(v, int) or v < 1 for v in values):
            rule = "must hold whole numbers of at least 1, one per layer"
            yield Fault(f"encoder.{name}", rule, value=values)
            return
    if config.observation != "pixels":
        return
    # Backwards through the layers: each needs (side - 1) * stride + kernel pixels.
    smallest, sizes = 1, (settings.kernel_sizes, settings.strides)
    for kernel, stride in zip(*map(reversed, sizes), strict=True):
        smallest = (smallest - 1) * stride + kernel
    if config.image_size < smallest:
        rule = "is too small for the encoder, whose convolutions leave nothing"
        way_out = f"use at least {smallest}"
        yield Fault("image_size", rule, way_out, config.image_size)
