"""From a checked config to the compiled functions of an agent."""

import dataclasses
import inspect
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import optax

from jaxil import methods
from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.errors import Fault, UsageError
from jaxil.learner.averaging import begin_average, make_averaging_step
from jaxil.learner.checked import checked_rewarder, told
from jaxil.learner.gathering import Step, make_gathering_step, make_repeated_step
from jaxil.learner.policy import (
    MeanAction,
    SampleAction,
    make_mean_action,
    make_sample_action,
)
from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec, make_refresh
from jaxil.learner.state import TrainState
from jaxil.learner.update import Learner, init_train_state, make_update_step
from jaxil.maths.types import AnyEpisode, Episode, ExpertEpisodes
from jaxil.native import build, encoding
from jaxil.networks.agent import AgentNetworks, make_agent_networks
from jaxil.training import lengths

_MAX_UPDATES = 2**31 - 1  # an int32 counts them


@dataclasses.dataclass(frozen=True)
class Agent:
    """The compiled functions of a run, and its first state.

    The methods `observe`, `rewards` and `plan` take a whole episode without padding,
    after the rewarder's state and the learner, and before the expert episodes; the
    fields `padded_*` take it padded. There is a plan only if the rewarder has one.
    """

    rewarder: Rewarder
    # (state, batch, expert batch, frames=None) -> (state, metrics); donates state.
    update_step: Step
    repeated_step: Step  # the same for several batches
    sample_action: SampleAction
    mean_action: MeanAction
    refresh: Any  # rewards of stored episodes as of now, see `rewarder.make_refresh`
    mean_image: np.ndarray | None  # the demonstrations', if the encoder subtracts it
    init_state: Callable[[], TrainState]  # the state before the first update
    usual_steps: int  # of an episode
    padded_observe: Any  # see `Rewarder`, like the next two
    padded_rewards: Any
    padded_plan: Any

    def compiled_length(self, num_steps: int) -> int:
        """Returns the length for which functions of an episode are compiled."""
        if not self.rewarder.ignores_padding:
            return num_steps
        return lengths.padded_length(num_steps, self.usual_steps)

    def observe(self, state: Any, params: Any, episode: Episode, experts: Any) -> Any:
        """Returns the rewarder's state after an episode."""
        return self.padded_observe(state, params, self._padded(episode), experts)

    def rewards(
        self, state: Any, params: Any, episode: Episode, experts: Any
    ) -> np.ndarray:
        """Returns an episode's rewards [T]."""
        found = self.padded_rewards(state, params, self._padded(episode), experts)
        return np.asarray(found)[: episode.num_steps]

    def plan(
        self, state: Any, params: Any, episode: Episode, experts: Any
    ) -> tuple[np.ndarray, int]:
        """Returns the rewarder's plan [T + 1, N + 1], and its demonstration's index."""
        found, index = self.padded_plan(state, params, self._padded(episode), experts)
        return np.asarray(found)[: episode.num_steps + 1], int(index)

    def _padded(self, episode: Episode) -> AnyEpisode:
        if not self.rewarder.ignores_padding:
            return episode  # whose number of steps is known when it is compiled
        return lengths.pad_episode(episode, self.compiled_length(episode.num_steps))


def stack_size(config: Config) -> int:
    """Returns the number of frames in an observation; states are not stacked."""
    return config.frame_stack if config.observation == "pixels" else 1


def exploration_schedule(config: Config) -> optax.Schedule:
    """Returns the standard deviation of the exploration noise, by agent step."""
    return optax.linear_schedule(
        config.exploration_std_start,
        config.exploration_std_end,
        config.exploration_std_steps,
    )


def exploration_by_update(config: Config) -> optax.Schedule:
    """Returns the same by update number, for the actions drawn in updates."""
    schedule = exploration_schedule(config)
    first = config.seed_frames // config.action_repeat
    every, at_once = config.update_every_steps, config.updates_per_step
    return lambda num_updates: schedule(first + num_updates * every // at_once)


def learning_rate(config: Config) -> optax.ScalarOrSchedule:
    """Returns the learning rate: constant, or a schedule by update number."""
    if not config.learning_rate_steps:
        return config.learning_rate
    share = config.updates_per_step / config.update_every_steps
    num_updates = min(math.ceil(config.learning_rate_steps * share), _MAX_UPDATES)
    return optax.linear_schedule(
        config.learning_rate, config.learning_rate_end, num_updates
    )


def make_networks(config: Config, action_dim: int, mean: Any) -> AgentNetworks:
    """Returns the agent's networks.

    `mean` is what the encoder subtracts, in [0, 1]: a number or [H, W, C].
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
    """Returns whether the encoder uses the convolutions in C, and loads them if so."""
    wanted = config.encoder.convolutions != "xla" and native_fault(config) is None
    return wanted and build.problem() is None


def native_fault(config: Config) -> str | None:
    """Returns why a config cannot use the convolutions in C; None if it can."""
    if config.observation != "pixels":
        return f"they need pixels, not observation={config.observation!r}"
    if config.compute_dtype != "float32":
        return f"they need float32, not compute_dtype={config.compute_dtype!r}"
    channels = tuple(config.encoder.channels)
    if any(each % encoding.FEATURES for each in channels):
        return (
            f"they need multiples of {encoding.FEATURES} channels, not "
            f"encoder.channels={channels}"
        )
    if len(channels) > encoding.MOST_LAYERS:
        return (
            f"they have at most {encoding.MOST_LAYERS} layers, not the {len(channels)} "
            f"of encoder.channels={channels}"
        )
    return None


def subtracted_mean(
    config: Config, demonstrations: loading.Demonstrations | None
) -> Any:
    """Returns what the encoder subtracts: 0.5, or the demonstrations' mean image."""
    if not config.encoder.subtract_mean_image or demonstrations is None:
        return 0.5
    total = np.zeros(demonstrations.frames.shape[2:], np.float64)
    num_frames = demonstrations.num_frames
    # One episode at a time bounds the memory.
    for episode, length in zip(demonstrations.frames, num_frames, strict=True):
        total += episode[:length].sum(axis=0, dtype=np.float64)
    mean = (total / num_frames.sum() / 255.0).astype(np.float32)
    return np.concatenate([mean] * config.frame_stack, axis=-1)


def make_rewarder(config: Config, networks: AgentNetworks) -> Rewarder:
    """Returns the rewarder of the method that the config names.

    Raises:
      UsageError: the method's function does not take the fields that it declares.
    """
    method = methods.get(config.method)
    agent = AgentSpec(
        networks=networks,
        frame_stack=stack_size(config),
        shift_padding=config.shift_padding,
    )
    make = methods.load(config.method, method.make_rewarder)
    fields, function = _own_fields(config), f"has a `{method.make_rewarder}` that"
    try:
        inspect.signature(make).bind(agent, **fields)
    except TypeError as error:
        rule = f"{function} does not take its fields: {error}"
        names = ", ".join(fields) or "none"
        way_out = f"give it the agent and, as keywords, the declared fields ({names})"
        raise UsageError(Fault("method", rule, way_out, config.method)) from error
    with told(config.method, method.make_rewarder):
        rewarder = make(agent, **fields)
    if not isinstance(rewarder, Rewarder):
        rule = f"{function} returns {type(rewarder).__name__}"
        raise UsageError(Fault("method", rule, "return a Rewarder", config.method))
    return checked_rewarder(config.method, rewarder)


def _own_fields(config: Config) -> dict[str, Any]:
    """Returns the fields of a method's own sections, by name."""
    sections = methods.get(config.method).sections
    return {k: v for name in sections for k, v in config[name].to_dict().items()}


def make_agent(
    config: Config,
    environment: PixelEnvironment,
    demonstrations: loading.Demonstrations | None,
) -> Agent:
    """Returns the compiled functions of a run.

    Of the environment, only specs and the length of episodes are read.
    """
    action_dim = environment.action_spec().shape[0]
    mean = subtracted_mean(config, demonstrations)
    networks = make_networks(config, action_dim, mean)
    rewarder = make_rewarder(config, networks)
    learner = Learner(
        networks=networks,
        rewarder=rewarder,
        learning_rate=learning_rate(config),
        critic_target_tau=config.critic_target_tau,
        noise_clip=config.noise_clip,
        shift_padding=config.shift_padding,
        pre_tanh_penalty=config.pre_tanh_penalty,
        exploration_std=exploration_by_update(config),
    )
    observation = np.zeros(
        environment.observation_spec().shape, environment.observation_spec().dtype
    )
    frames = None if demonstrations is None else demonstrations.frames
    spec = Spec(
        action_dim=action_dim,
        num_demonstrations=0 if frames is None else frames.shape[0],
        expert_steps=0 if frames is None else frames.shape[1] - 1,
        observation_shape=observation.shape,
    )
    step = make_gathering_step(_make_step(config, learner))

    def init_state() -> TrainState:
        key = jax.random.key(config.seed)
        state = init_train_state(learner, key, observation, spec)
        return begin_average(state) if config.policy_tau < 1.0 else state

    return Agent(
        rewarder=rewarder,
        # The old state is dead after the call, so XLA may reuse its memory.
        update_step=jax.jit(step, donate_argnums=0),
        repeated_step=jax.jit(make_repeated_step(step), donate_argnums=0),
        sample_action=jax.jit(
            make_sample_action(networks, exploration_schedule(config))
        ),
        mean_action=jax.jit(make_mean_action(networks)),
        refresh=jax.jit(make_refresh(rewarder)),
        mean_image=mean if isinstance(mean, np.ndarray) else None,
        # Compiled, and cached: dispatched one by one, its 450 operations take longer.
        init_state=jax.jit(init_state),
        usual_steps=environment.episode_steps,
        padded_observe=jax.jit(rewarder.observe),
        padded_rewards=jax.jit(rewarder.rewards),
        padded_plan=None if rewarder.plan is None else jax.jit(rewarder.plan),
    )


def _make_step(config: Config, learner: Learner) -> Step:
    """Returns the method's update step, which averages policies if they are averaged.

    Raises:
      UsageError, MethodError: its own `make_update_step` fails.
    """
    step, method = make_update_step(learner), methods.get(config.method)
    if method.make_update_step is not None:
        make_step = methods.load(config.method, method.make_update_step)
        with told(config.method, method.make_update_step):
            step = make_step(learner, **_own_fields(config))
    if config.policy_tau < 1.0:
        step = make_averaging_step(step, tau=config.policy_tau)
    return step


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
