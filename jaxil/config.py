"""All settings with their defaults, and the one door where they are checked."""

import difflib
import math
from collections.abc import Iterator
from typing import Any

import ml_collections

from jaxil.replay import replay

# An ml_collections.ConfigDict, whose fields no type checker can know.
Config = Any

METHODS = {
    "pdac": "adversarial rewards on the critic's features (P-DAC)",
    "psil": "optimal transport to the closest demonstration (P-SIL)",
    "dac": "adversarial rewards on pixels and actions (DAC)",
    "sil": "optimal transport in an adversarial embedding (SIL)",
    "bc": "the expert's actions, copied (behavioural cloning)",
    "drqv2": "the environment's own reward (DrQ-v2)",
    "zero": "no reward at all: the control",
}
OBSERVATIONS = ("pixels", "state")
COSTS = ("cosine", "euclidean")
ALIGNMENTS = ("transport", "time")
RENDER_QUALITIES = ("paper", "fast", "smooth")
COMPUTE_DTYPES = ("float32", "bfloat16")
CONVOLUTIONS = ("auto", "native", "xla")

# The paper's budgets, in environment frames; other tasks get the larger one.
_EASY_TASKS = ("cartpole_swingup", "finger_spin", "ball_in_cup_catch")
_EASY_FRAMES, _HARD_FRAMES = 1_500_000, 5_000_000
_CLONING_UPDATES = 55_000  # in the reference

_SHORT_LIST = 12  # names that a message may list in full


def default_config(method: str = "pdac", task: str = "cartpole_swingup") -> Config:
    """Returns the paper's settings for a method on a task.

    Durations end in their unit: `_frames` are environment frames, before action
    repeat; `_steps` are the agent's decisions.
    """
    config: Config = ml_collections.ConfigDict()
    config.method = method
    config.task = task
    config.seed = 0

    # What the agent sees and does.
    config.observation = "pixels"  # or "state", for experts that learn quickly
    config.action_repeat = 2
    config.image_size = 84
    config.frame_stack = 3
    config.render_quality = "paper"  # dm_control's own; see `Renderer`
    config.total_frames = _EASY_FRAMES if task in _EASY_TASKS else _HARD_FRAMES

    # Replay and schedule.
    config.replay_size_steps = 150_000  # also bounds how stale stored rewards get
    # Agent steps between two recomputations of all stored rewards, at an episode's end;
    # 0, as in the paper: an episode keeps the rewards that it got at its end.
    config.reward_refresh_steps = 0
    config.batch_size = 256
    config.num_steps = 1 if task.startswith("walker") else 3  # of n-step returns
    config.discount_factor = 0.99
    config.seed_frames = 4_000  # before the first update
    config.exploration_steps = 2_000  # of uniform actions
    config.update_every_steps = 2

    # DrQ-v2.
    config.learning_rate = 1e-4
    config.feature_dim = 50
    config.hidden_dim = 1024
    config.critic_target_tau = 0.01
    config.noise_clip = 0.3
    config.exploration_std_start = 1.0
    config.exploration_std_end = 0.1
    config.exploration_std_steps = 500_000
    config.shift_padding = 4  # pixels of the random shift; 0 turns it off
    config.pre_tanh_penalty = 0.0  # not in the paper; keeps small nets unsaturated

    config.encoder = ml_collections.ConfigDict()
    config.encoder.channels = (32, 32, 32, 32)
    config.encoder.kernel_sizes = (3, 3, 3, 3)
    config.encoder.strides = (2, 1, 1, 1)
    config.encoder.contrast = 1.0
    config.encoder.subtract_mean_image = False  # the demonstrations' mean, not 0.5
    # "auto" takes our own on CPUs with GCC, in float32, where channels come in 32s, and
    # XLA's elsewhere; "native" and "xla" take these or nothing. See `jaxil.native.build`.
    config.encoder.convolutions = "auto"

    config.demonstrations = ml_collections.ConfigDict()
    config.demonstrations.source = ""  # a file or folder; "" is the shipped file
    config.demonstrations.num_episodes = 10
    config.demonstrations.frame_skip = 1  # of pixel files: every so many-th frame

    # P-SIL and SIL; what is paired, and by which cost, is the paper's figure 7.
    config.sinkhorn = ml_collections.ConfigDict()
    config.sinkhorn.cost = "cosine"  # or "euclidean"
    config.sinkhorn.alignment = "transport"  # or "time": moment t with moment t
    config.sinkhorn.epsilon = 0.01
    config.sinkhorn.num_iterations = 100
    config.sinkhorn.target_update_steps = 10_000
    config.sinkhorn.return_scale = 10.0  # the first episode returns minus this

    # P-DAC, DAC, and the embedding of SIL, which is an adversary too.
    config.discriminator = ml_collections.ConfigDict()
    config.discriminator.hidden_dim = 1024
    config.discriminator.learning_rate = 1e-4
    config.discriminator.gradient_penalty = 10.0
    config.discriminator.batch_size = 128
    config.discriminator.sees_actions = False

    # BC. It plays no episode: its frames count updates as other methods' would.
    config.cloning = ml_collections.ConfigDict()
    config.cloning.batch_size = 128
    config.cloning.std = 0.1  # of the policy whose likelihood is raised
    if method == "bc":
        per_update = config.update_every_steps * config.action_repeat
        config.total_frames = _CLONING_UPDATES * per_update

    # Speed, on a GPU above all. A copy of the replay's frames lies on the device and
    # batches send only their places there; the samples are the same, and the ring in
    # the host's memory stays what checkpoints save.
    config.replay_on_device = False
    # So many updates are sent to the device at once: less waiting, but the policy that
    # acts lags by that less one. Episode ends, evaluations and checkpoints see all.
    config.updates_per_dispatch = 1
    # So many environments play side by side, each in a process of its own. All of them
    # take one decision by the same policy, which so lags by that less one; frames in
    # all, and frames for each update, stay the same.
    config.num_environments = 1
    # Of convolutions and the product that follows them; all that is kept is float32.
    config.compute_dtype = "float32"  # or "bfloat16"

    # Looking at it.
    config.eval_every_frames = 10_000
    config.num_eval_episodes = 10
    config.checkpoint_every_frames = 10_000
    config.video_every_evals = 5  # 0 turns videos off
    return config


def uses_demonstrations(config: Config) -> bool:
    """Says whether a run of this config reads demonstrations."""
    return config.method not in ("drqv2", "zero") or config.encoder.subtract_mean_image


def sees_actions(config: Config) -> bool:
    """Says whether the method reads the expert's actions."""
    return config.method in ("bc", "dac") or (
        config.method == "pdac" and config.discriminator.sees_actions
    )


def memory_bytes(config: Config) -> int:
    """Returns what the replay of this config will hold when full, in bytes.

    For pixels only; state vectors are small.
    """
    return replay.memory_bytes(**_ring_sizes(config), action_dim=8)


def device_memory_bytes(config: Config) -> int:
    """Returns what the copy of the replay's frames takes on jax's device, in bytes.

    It is reserved at the start; 0 unless `replay_on_device`. For pixels only.
    """
    return replay.frames_bytes(**_ring_sizes(config)) if config.replay_on_device else 0


def _ring_sizes(config: Config) -> dict[str, Any]:
    return {
        "capacity_steps": config.replay_size_steps,
        "episode_steps": max(1000 // config.action_repeat, 1),
        "observation_shape": (config.image_size, config.image_size, 3),
        "observation_dtype": "uint8",
    }


def problems(config: Config, known_tasks: tuple[str, ...]) -> list[str]:
    """Checks every field.

    Args:
      config: as `default_config` makes it, with changes.
      known_tasks: all tasks that can be run.

    Returns:
      One sentence for each fault: field, value, rule, way out.
    """
    return list(_problems(config, known_tasks))


def unknown_name(field: str, value: object, known: tuple[str, ...]) -> str:
    """Returns a sentence about a name that does not exist, with the closest ones."""
    if len(known) <= _SHORT_LIST:
        return f"{field}={value!r} is unknown; choose one of: {', '.join(known)}"
    close = difflib.get_close_matches(str(value), known, n=3, cutoff=0.5)
    shown = ", ".join(close) if close else f"{', '.join(known[:_SHORT_LIST])}, ..."
    hint = "did you mean" if close else "choose one of"
    return f"{field}={value!r} is unknown; {hint}: {shown}"


# field: (smallest, largest, why or way out)
_RANGES: dict[str, tuple[float, float, str]] = {
    "seed": (0, 2**31 - 1, "it seeds NumPy and JAX"),
    "action_repeat": (1, 100, "2 in the paper"),
    "image_size": (8, 1024, "84 in the paper"),
    "frame_stack": (1, 16, "3 in the paper"),
    "total_frames": (1, 10**10, "the run's length in environment frames"),
    "replay_size_steps": (
        1_000,
        10**8,
        "it must hold whole episodes; 150000 in the paper",
    ),
    "reward_refresh_steps": (0, 10**9, "0, the paper's, never recomputes rewards"),
    "batch_size": (1, 65_536, "256 in the paper"),
    "num_steps": (1, 100, "3 in the paper, 1 on walker tasks"),
    "discount_factor": (0.0, 1.0, "0.99 in the paper"),
    "seed_frames": (1, 10**9, "frames before the first update; 4000 in DrQ-v2"),
    "exploration_steps": (0, 10**9, "agent steps of uniform actions; 2000 in DrQ-v2"),
    "update_every_steps": (1, 10**6, "2 in the paper"),
    "updates_per_dispatch": (1, 1_000, "1 lets the policy follow each update"),
    "num_environments": (1, 64, "each is a process; 1 plays in this one"),
    "feature_dim": (1, 10**5, "50 in the paper"),
    "hidden_dim": (1, 10**5, "1024 in the paper"),
    "noise_clip": (0.0, 2.0, "0.3 in DrQ-v2"),
    "exploration_std_start": (0.0, 10.0, "1 in the paper"),
    "exploration_std_end": (0.0, 10.0, "0.1 in the paper"),
    "exploration_std_steps": (1, 10**9, "500000 in the paper"),
    "shift_padding": (0, 512, "4 in the paper, 0 for no augmentation"),
    "pre_tanh_penalty": (0.0, 1e3, "0 in the paper"),
    "encoder.contrast": (1e-6, 1e6, "1 in the paper"),
    "demonstrations.num_episodes": (1, 10**6, "1, 10 or 50 in the paper"),
    "demonstrations.frame_skip": (1, 10**4, "1 keeps every frame of a pixel file"),
    "sinkhorn.epsilon": (1e-6, 1e3, "0.01 in the reference"),
    "sinkhorn.num_iterations": (1, 10**6, "100 in the reference"),
    "sinkhorn.target_update_steps": (1, 10**9, "10000 in the paper"),
    "sinkhorn.return_scale": (1e-6, 1e6, "10 in the paper"),
    "discriminator.hidden_dim": (1, 10**5, "1024 in the reference"),
    "discriminator.gradient_penalty": (0.0, 1e6, "10 in the paper"),
    "discriminator.batch_size": (1, 65_536, "128 in the reference"),
    "cloning.batch_size": (1, 65_536, "128 in the reference"),
    "cloning.std": (1e-6, 10.0, "0.1 in the reference"),
    "eval_every_frames": (1, 10**10, "10000 in DrQ-v2"),
    "num_eval_episodes": (1, 10**4, "10 in DrQ-v2"),
    "checkpoint_every_frames": (1, 10**10, "what a killed run loses at most"),
    "video_every_evals": (0, 10**6, "0 turns videos off"),
}
_RATES = ("learning_rate", "discriminator.learning_rate", "critic_target_tau")
_WHOLE_DECISIONS = (
    "total_frames",
    "seed_frames",
    "eval_every_frames",
    "checkpoint_every_frames",
)


def _read(config: Config, field: str):
    value = config
    for part in field.split("."):
        value = value[part]
    return value


def _problems(config: Config, known_tasks: tuple[str, ...]) -> Iterator[str]:
    """Yields one sentence for each fault."""
    if config.method not in METHODS:
        yield unknown_name("method", config.method, tuple(METHODS))
    if config.task not in known_tasks:
        yield unknown_name("task", config.task, known_tasks)
    if config.observation not in OBSERVATIONS:
        yield unknown_name("observation", config.observation, OBSERVATIONS)
    if config.compute_dtype not in COMPUTE_DTYPES:
        yield unknown_name("compute_dtype", config.compute_dtype, COMPUTE_DTYPES)
    if config.encoder.convolutions not in CONVOLUTIONS:
        value = config.encoder.convolutions
        yield unknown_name("encoder.convolutions", value, CONVOLUTIONS)
    if config.render_quality not in RENDER_QUALITIES:
        yield unknown_name("render_quality", config.render_quality, RENDER_QUALITIES)
    for field, known in (("cost", COSTS), ("alignment", ALIGNMENTS)):
        if config.sinkhorn[field] not in known:
            yield unknown_name(f"sinkhorn.{field}", config.sinkhorn[field], known)
    in_range = set()
    for field, (low, high, why) in _RANGES.items():
        value = _read(config, field)
        if math.isfinite(value) and low <= value <= high:
            in_range.add(field)
        else:
            yield f"{field}={value} must lie in [{low}, {high}]: {why}"
    for field in _RATES:
        value = _read(config, field)
        if not 0.0 < value <= 1.0:
            yield f"{field}={value} must lie in (0, 1]; 1e-4 to 1e-2 is usual"
    for field in _WHOLE_DECISIONS:
        value, repeat = _read(config, field), config.action_repeat
        if {field, "action_repeat"} <= in_range and value % repeat:
            nearest = max(round(value / repeat), 1) * repeat
            yield (
                f"{field}={value} is not a multiple of action_repeat={repeat}, so it "
                f"ends inside a decision; use {nearest}"
            )
    if config.exploration_std_end > config.exploration_std_start:
        yield (
            f"exploration_std_end={config.exploration_std_end} is above "
            f"exploration_std_start={config.exploration_std_start}; noise must not grow"
        )
    both = {"batch_size", "discriminator.batch_size"} <= in_range
    too_large = both and config.discriminator.batch_size > config.batch_size
    if config.method in ("pdac", "dac", "sil") and too_large:
        yield (
            f"discriminator.batch_size={config.discriminator.batch_size} is above "
            f"batch_size={config.batch_size}: it reuses the agent's encoded samples; "
            f"use at most {config.batch_size}"
        )
    if config.observation == "state" and config.encoder.subtract_mean_image:
        yield (
            "encoder.subtract_mean_image=True needs observation='pixels': a state "
            "vector has no mean image; set it to False"
        )
    yield from _encoder_problems(config)


def _encoder_problems(config: Config) -> Iterator[str]:
    settings = config.encoder
    lengths = {
        name: len(settings[name]) for name in ("channels", "kernel_sizes", "strides")
    }
    if len(set(lengths.values())) != 1:
        yield (
            f"encoder: lengths differ ({lengths}); channels, kernel_sizes and strides "
            "need one entry for each layer"
        )
        return
    for name in lengths:
        if any(not isinstance(v, int) or v < 1 for v in settings[name]):
            yield f"encoder.{name}={settings[name]} needs whole numbers of at least 1"
            return
    if config.observation != "pixels":
        return
    # Backwards through the layers: each needs (side - 1) * stride + kernel pixels.
    smallest = 1
    for size, stride in zip(
        reversed(settings.kernel_sizes), reversed(settings.strides), strict=True
    ):
        smallest = (smallest - 1) * stride + size
    if config.image_size < smallest:
        yield (
            f"image_size={config.image_size} is too small for the encoder: its "
            f"convolutions leave nothing; use at least {smallest}"
        )
