"""From a checked config to the parts of a run: environments, learner, rewarder."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import optax

from jaxil import config as jaxil_config
from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments.pool import Pool
from jaxil.environments.suite import PixelEnvironment, known_tasks, make_environment
from jaxil.learner.cloning import make_cloning_step
from jaxil.learner.gathering import Step, make_gathering_step, make_repeated_step
from jaxil.learner.policy import (
    Exploit,
    Explore,
    ExploreTogether,
    make_exploit,
    make_explore,
    make_explore_together,
)
from jaxil.learner.refreshing import make_refresh
from jaxil.learner.rewarder import Rewarder, Spec
from jaxil.learner.state import TrainState
from jaxil.learner.update import (
    Learner,
    init_train_state,
    make_update_step,
)
from jaxil.machine import memory
from jaxil.machine.progress import ProgressLine
from jaxil.maths.types import ExpertEpisodes
from jaxil.native import build, encoding
from jaxil.networks.agent import AgentNetworks, make_agent_networks
from jaxil.replay.replay import Replay
from jaxil.rewarders.dac import make_dac_rewarder
from jaxil.rewarders.matching import make_matching
from jaxil.rewarders.pdac import make_adversarial_rewarder
from jaxil.rewarders.psil import make_sinkhorn_rewarder
from jaxil.rewarders.sil import make_sil_rewarder
from jaxil.rewarders.task import make_task_rewarder, make_zero_rewarder

# Added to the seed for what must not share its random starts with training.
_EVALUATION_SEED = 1_000_003
# A fault in one of these leaves no sense in opening the demonstrations.
_READING_FIELDS = ("demonstrations.", "image_size", "action_repeat", "observation")


class Agent(NamedTuple):
    """The compiled functions of a run, and what they start from.

    Attributes:
      update_step: (state, batch, expert batch, frames=None) -> (state, metrics);
        donates state; see `gathering.make_gathering_step`.
      repeated_step: the same for several batches, see `gathering.make_repeated_step`.
      explore: see `policy.make_explore`.
      explore_together: see `policy.make_explore_together`.
      exploit: see `policy.make_exploit`.
      rewards: the rewarder's, at episode end.
      refresh: rewards of stored episodes as of now, see `refreshing.make_refresh`.
      plan: the rewarder's, for people; None where it has none.
      rewarder: the method itself.
      init_state: () -> the state before the first update.
    """

    update_step: Step
    repeated_step: Step
    explore: Explore
    explore_together: ExploreTogether
    exploit: Exploit
    rewards: Any
    refresh: Any
    plan: Any
    rewarder: Rewarder
    init_state: Any


def problems(config: Config) -> list[str]:
    """Returns one sentence for each reason why a config can't be run here.

    Reads the demonstration file, but renders nothing.
    """
    faults = jaxil_config.problems(config, known_tasks())
    fault = None
    has_encoder = not any(each.startswith("encoder") for each in faults)
    if config.encoder.convolutions == "native" and has_encoder:
        fault = _native_fault(config) or build.problem()
    if fault is not None:
        faults.append(
            f"encoder.convolutions='native' can't be had: {fault}; 'auto' takes XLA's "
            "where it has to"
        )
    readable = config.task in known_tasks() and not any(
        fault.startswith(_READING_FIELDS) for fault in faults
    )
    if readable and jaxil_config.uses_demonstrations(config):
        fault = demonstration_fault(config)
        if fault is not None:
            faults.append(
                f"demonstrations.source={config.demonstrations.source!r}: {fault}"
            )
    return faults


def demonstration_fault(config: Config) -> str | None:
    """Returns why the config's demonstrations can't serve it; None if they can."""
    try:
        loading.check(
            config.demonstrations.source,
            sees_actions=jaxil_config.sees_actions(config),
            **_file_settings(config),
        )
    except DemonstrationError as error:
        return str(error)
    return None


def renderer_name(config: Config) -> str:
    """Returns what GL calls the device that will draw this run's pixels.

    Raises:
      RuntimeError: nothing here can render.
    """
    environment = training_environment(config)
    name = environment.renderer.gl_name()
    environment.close()
    return name


def training_environment(config: Config) -> PixelEnvironment:
    """Returns the environment that gathers experience."""
    return environment_with_seed(config, config.seed)


def evaluation_environment(config: Config) -> PixelEnvironment:
    """Returns an environment of its own, with starts of its own."""
    return environment_with_seed(config, config.seed + _EVALUATION_SEED)


def environment_with_seed(config: Config, seed: int) -> PixelEnvironment:
    """Returns the run's environment with another seed for its resets."""
    return make_environment(config.task, seed=seed, **_environment_settings(config))


def training_pool(
    config: Config, environment: PixelEnvironment, say: Callable[[str], None]
) -> Pool | None:
    """Returns processes that gather experience side by side; None for a single one.

    Their environments have one seed: an episode's number alone fixes its start,
    whichever of them plays it.

    Args:
      config: checked.
      environment: such as the processes make; what it shows is not kept.
      say: takes a line for people.
    """
    if config.num_environments == 1 or config.method == "bc":  # which plays nothing
        return None
    # The child finds what this names without jax, which would take memory and seconds.
    make = functools.partial(
        make_environment, config.task, seed=config.seed, **_environment_settings(config)
    )
    return Pool(
        make,
        config.num_environments,
        observation=environment.reset(episode=0).observation,
        frame=environment.single_observation(),
        say=say,
    )


def _environment_settings(config: Config) -> dict[str, Any]:
    return {
        "action_repeat": config.action_repeat,
        "image_size": config.image_size,
        "frame_stack": config.frame_stack,
        "render_quality": config.render_quality,
        "observation": config.observation,
    }


def load_demonstrations(
    config: Config,
) -> loading.Demonstrations | None:
    """Returns the demonstrations of a run, rendered as the agent sees; or None.

    Drawing them takes minutes at quality `paper` in software, the first time: a
    progress line is shown.

    Raises:
      DemonstrationError: the file can't serve this run.
    """
    if not jaxil_config.uses_demonstrations(config):
        return None
    lines: list[ProgressLine] = []

    def show(done: int, total: int) -> None:
        if not lines:
            label = "drawing the demonstrations, once"
            lines.append(
                ProgressLine(total, first_frame=done, label=label, unit="images")
            )
        lines[0].update(done, {})

    try:
        return loading.load(
            config.demonstrations.source,
            render_quality=config.render_quality,
            progress=show,
            **_file_settings(config),
        )
    finally:
        for line in lines:
            line.close()


def _file_settings(config: Config) -> dict[str, Any]:
    """Returns what decides whether a demonstration file can serve a run."""
    return {
        "task": config.task,
        "num_episodes": config.demonstrations.num_episodes,
        "action_repeat": config.action_repeat,
        "image_size": config.image_size,
        "observation": config.observation,
        "frame_skip": config.demonstrations.frame_skip,
        "max_bytes": memory.spare_bytes(),
    }


def make_replay(config: Config, environment: PixelEnvironment) -> Replay:
    """Returns an empty replay of the config's size."""
    frame = environment.reset(episode=0) and environment.single_observation()
    return Replay(
        capacity_steps=config.replay_size_steps,
        episode_steps=environment.episode_steps or config.replay_size_steps,
        observation_shape=frame.shape,
        observation_dtype=frame.dtype,
        action_dim=environment.action_spec().shape[0],
        frame_stack=stack_size(config),
        num_steps=config.num_steps,
        discount_factor=config.discount_factor,
    )


def stack_size(config: Config) -> int:
    """Returns the frames in an observation: state vectors are not stacked."""
    return config.frame_stack if config.observation == "pixels" else 1


def exploration_schedule(config: Config) -> optax.Schedule:
    """Returns the noise's standard deviation by agent step."""
    return optax.linear_schedule(
        config.exploration_std_start,
        config.exploration_std_end,
        config.exploration_std_steps,
    )


def make_networks(config: Config, action_dim: int, mean: Any) -> AgentNetworks:
    """Returns the agent's networks.

    Args:
      config: checked.
      action_dim: A.
      mean: what the encoder subtracts, in [0, 1]: a number or [H, W, C].
    """
    return make_agent_networks(
        action_dim=action_dim,
        feature_dim=config.feature_dim,
        hidden_dim=config.hidden_dim,
        observation=config.observation,
        channels=tuple(config.encoder.channels),
        kernel_sizes=tuple(config.encoder.kernel_sizes),
        strides=tuple(config.encoder.strides),
        contrast=config.encoder.contrast,
        mean=mean,
        compute_dtype=config.compute_dtype,
        native=uses_native_convolutions(config),
    )


def uses_native_convolutions(config: Config) -> bool:
    """Returns whether the encoder's convolutions are our own, and loads them if so."""
    wanted = config.encoder.convolutions != "xla" and _native_fault(config) is None
    return wanted and build.problem() is None


def _native_fault(config: Config) -> str | None:
    """Returns why our own convolutions are not for a config."""
    if config.observation != "pixels":
        return f"they are for pixels, not observation={config.observation!r}"
    if config.compute_dtype != "float32":
        return f"they are for float32, not compute_dtype={config.compute_dtype!r}"
    channels = tuple(config.encoder.channels)
    if any(each % encoding.FEATURES for each in channels):
        return (
            f"they make multiples of {encoding.FEATURES} channels, not "
            f"encoder.channels={channels}"
        )
    if len(channels) > encoding.MOST_LAYERS:
        return (
            f"they have at most {encoding.MOST_LAYERS} layers, not the {len(channels)} "
            f"of encoder.channels={channels}"
        )
    return None


def mean_image(
    config: Config,
    demonstrations: loading.Demonstrations | None,
) -> Any:
    """Returns what the encoder subtracts: 0.5, or the demonstrations' mean image."""
    if not config.encoder.subtract_mean_image or demonstrations is None:
        return 0.5
    total = np.zeros(demonstrations.frames.shape[2:], np.float64)
    lengths = demonstrations.num_frames
    for episode, length in zip(demonstrations.frames, lengths, strict=True):
        # One at a time: bounded memory.
        total += episode[:length].sum(axis=0, dtype=np.float64)
    mean = (total / lengths.sum() / 255.0).astype(np.float32)
    return np.concatenate([mean] * config.frame_stack, axis=-1)


def make_rewarder(config: Config, networks: AgentNetworks) -> Rewarder:
    """Returns the imitation method that the config names."""
    adversary = {
        "learning_rate": config.discriminator.learning_rate,
        "batch_size": config.discriminator.batch_size,
        "frame_stack": stack_size(config),
    }
    if config.method == "pdac":
        return make_adversarial_rewarder(
            networks,
            hidden_dim=config.discriminator.hidden_dim,
            penalty_weight=config.discriminator.gradient_penalty,
            sees_actions=config.discriminator.sees_actions,
            shift_padding=config.shift_padding,
            **adversary,
        )
    if config.method == "dac":
        return make_dac_rewarder(
            networks,
            feature_dim=config.feature_dim,
            hidden_dim=config.discriminator.hidden_dim,
            penalty_weight=config.discriminator.gradient_penalty,
            **adversary,
        )
    matching = make_matching(
        cost=config.sinkhorn.cost,
        alignment=config.sinkhorn.alignment,
        epsilon=config.sinkhorn.epsilon,
        num_iterations=config.sinkhorn.num_iterations,
    )
    if config.method == "sil":
        return make_sil_rewarder(
            networks,
            matching=matching,
            feature_dim=config.feature_dim,
            return_scale=config.sinkhorn.return_scale,
            **adversary,
        )
    if config.method == "psil":
        return make_sinkhorn_rewarder(
            networks,
            matching=matching,
            target_update_steps=config.sinkhorn.target_update_steps,
            return_scale=config.sinkhorn.return_scale,
            frame_stack=stack_size(config),
        )
    if config.method == "drqv2":
        return make_task_rewarder()
    return make_zero_rewarder()


def make_agent(
    config: Config,
    environment: PixelEnvironment,
    demonstrations: loading.Demonstrations | None,
) -> Agent:
    """Returns the compiled functions of a run.

    Args:
      config: checked.
      environment: read for its specs only.
      demonstrations: what the method imitates, or None.
    """
    action_dim = environment.action_spec().shape[0]
    networks = make_networks(config, action_dim, mean_image(config, demonstrations))
    rewarder = make_rewarder(config, networks)
    schedule = exploration_schedule(config)
    first_update = config.seed_frames // config.action_repeat
    learner = Learner(
        networks=networks,
        rewarder=rewarder,
        learning_rate=config.learning_rate,
        critic_target_tau=config.critic_target_tau,
        noise_clip=config.noise_clip,
        shift_padding=config.shift_padding,
        pre_tanh_penalty=config.pre_tanh_penalty,
        exploration_std=lambda num_updates: schedule(
            first_update + num_updates * config.update_every_steps
        ),
    )
    frames = None if demonstrations is None else demonstrations.frames
    spec = Spec(
        action_dim=action_dim,
        feature_dim=config.feature_dim,
        num_demonstrations=0 if frames is None else frames.shape[0],
        expert_steps=0 if frames is None else frames.shape[1] - 1,
        observation_shape=environment.observation_spec().shape,
    )
    observation = np.zeros(
        environment.observation_spec().shape, environment.observation_spec().dtype
    )
    step = make_update_step(learner)
    if config.method == "bc":
        step = make_cloning_step(learner, std=config.cloning.std)
    step = make_gathering_step(step)
    return Agent(
        # The old state is dead after the call, so XLA may reuse its memory.
        update_step=jax.jit(step, donate_argnums=0),
        repeated_step=jax.jit(make_repeated_step(step), donate_argnums=0),
        explore=jax.jit(make_explore(networks, schedule)),
        explore_together=jax.jit(make_explore_together(networks, schedule)),
        exploit=jax.jit(make_exploit(networks)),
        rewards=jax.jit(rewarder.rewards),
        refresh=jax.jit(make_refresh(rewarder)),
        plan=None if rewarder.plan is None else jax.jit(rewarder.plan),
        rewarder=rewarder,
        # Compiled, and kept in the cache: one by one, its 450 operations take longer.
        init_state=jax.jit(
            lambda: init_train_state(
                learner, jax.random.key(config.seed), observation, spec
            )
        ),
    )


def expert_episodes(
    rewarder: Rewarder, demonstrations: loading.Demonstrations | None
) -> ExpertEpisodes | None:
    """Puts the demonstrations on the device, where the method matches episodes."""
    if not rewarder.matches_episodes or demonstrations is None:
        return None
    actions = demonstrations.actions
    if actions is None:
        actions = np.zeros((*demonstrations.frames.shape[:1], 0, 0), np.float32)
    return ExpertEpisodes(
        jax.numpy.asarray(demonstrations.frames),
        jax.numpy.asarray(demonstrations.num_frames),
        jax.numpy.asarray(actions),
    )


def abstract_state(agent: Agent) -> TrainState:
    """Returns shapes and dtypes of the learner's state, for a checkpoint to fill."""
    return jax.eval_shape(agent.init_state)
