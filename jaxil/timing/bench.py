"""A run whose parts can be called one at a time."""

import contextlib
import io
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxil import train
from jaxil.config import Config
from jaxil.errors import told_as
from jaxil.machine.progress import ProgressLine
from jaxil.maths.types import Episode
from jaxil.training import agent as agents
from jaxil.training import assembly

_RENDERED_FRAMES = 20  # of the random episode; rendering 500 would take too long


class _Loop(train.Run):
    """A run that neither evaluates nor saves."""

    waits = False  # whether the environment waits for each update

    def learn(self, num_steps: int) -> None:
        super().learn(num_steps)
        if self.waits:
            jax.block_until_ready(self.state.num_updates)

    def wants_episode(self) -> bool:
        return True  # even if the budget is less than an episode

    def evaluate(self) -> None:
        pass

    def save(self) -> None:
        pass


class Bench:
    """A run that has stored one episode of random actions and updated once.

    It acts and learns from the first agent step.
    """

    def __init__(self, config: Config, folder: pathlib.Path) -> None:
        """Starts the run of a checked config in a folder."""
        self.config = config = config.copy_and_resolve_references()
        with config.unlocked():
            config.exploration_steps = 0
            config.seed_frames = config.total_frames = config.action_repeat
        # A run may dispatch several updates at once.
        self._num_updates = config.updates_per_dispatch
        self._demonstrations = assembly.load_demonstrations(config)
        with contextlib.ExitStack() as opened:
            self.run = _Loop.make(config, folder, self._demonstrations)
            opened.callback(self.run.close)
            self._environment = assembly.training_environment(config)
            opened.callback(self._environment.close)
            self._begin()
            self._closing = opened.pop_all()
        self.close = self._closing.close  # environments, their processes and files

    def _begin(self) -> None:
        """Stores and rewards an episode, updates once and starts the workers."""
        run, config = self.run, self.config
        run.progress = ProgressLine(config.total_frames, stream=io.StringIO())
        self._rng = np.random.default_rng(0)
        self.episode = self._random_episode()
        self.observation = self._environment.reset(episode=0).observation
        run.reward(self.episode)  # a rewarder may have to observe one before it learns
        self.add_episode()
        self.batches = self.sample()  # of one update, on the host
        dispatched: Any = self.batches
        if self._num_updates > 1:
            copies = [self.batches] * self._num_updates
            dispatched = jax.tree.map(lambda *leaves: np.stack(leaves), *copies)
        self._on_device = jax.device_put(dispatched)
        begin = time.perf_counter()
        jax.block_until_ready(self.update())
        # Compilation included.
        self.first_update_seconds = time.perf_counter() - begin
        if run.player is not None and config.num_environments > 1:
            # Start the workers and compile their policy before anything is timed.
            run.player.begin(lambda: True)
            run.act(run.player.observations)

    def parts(self) -> dict[str, tuple[Callable[[], Any] | None, int]]:
        """Returns a run's parts by name, None for one that it does not have.

        With each stands how often one call executes it.
        """
        run = self.run
        return {
            "physics_ms": (self._physics_step(), 1),
            "render_ms": (self._environment.render, 1),
            "act_ms": (lambda: run.act(self.observation[None]), 1),
            "sample_ms": (self.sample, 1),
            "update_ms": (self.update, self._num_updates),
            "reward_ms": (lambda: run.reward(self.episode), 1),
        }

    def sample(self) -> Any:
        """Returns the batches of one update."""
        return self.run.updates.sample(self._rng)

    def update(self) -> Any:
        """Dispatches as many updates as a run does at once; returns the new state."""
        run, agent = self.run, self.run.agent
        step = agent.repeated_step if self._num_updates > 1 else agent.update_step
        run.state, run.counters.metrics = step(
            run.state, *self._on_device, run.updates.frames()
        )
        return run.state

    def add_episode(self) -> None:
        """Stores the random episode."""
        self.run.replay.add_episode(**self.episode._asdict())
        self.run.updates.episode_added()

    def fill_replay(self) -> None:
        """Stores episodes until the replay is full, then updates."""
        for _ in range(self.config.replay_size_steps // len(self.episode.actions) + 1):
            self.add_episode()
        jax.block_until_ready(self.update())

    def loop(self, steps: int, *, waits: bool) -> tuple[int, float, float]:
        """Acts and learns for `steps` agent steps, summed over all environments.

        With `waits`, environments wait for each update. Returns environment frames,
        seconds, and those of them that environments, acting and updates took.
        """
        run, first_frame = self.run, self.run.frame
        run.waits, before = waits, sum(run.stopwatch.seconds.values())
        with self.config.unlocked():
            self.config.total_frames = first_frame + steps * self.config.action_repeat
        begin = time.perf_counter()
        run.loop(whole_episodes=False)
        # The last update may not have finished.
        with run.stopwatch.timed("update"):
            jax.block_until_ready(run.state.num_updates)
        seconds = time.perf_counter() - begin
        working = sum(run.stopwatch.seconds.values()) - before
        return run.frame - first_frame, seconds, working

    def lower(self, *, convolutions: str | None = None) -> Any:
        """Traces and lowers one update, optionally with other `convolutions`."""
        run, agent = self.run, self.run.agent
        if convolutions is not None:
            config = self.config.copy_and_resolve_references()
            with config.unlocked():
                config.encoder.convolutions = convolutions
            agent = agents.make_agent(config, self._environment, self._demonstrations)
        shapes = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype),
            (run.state, *self.batches, run.updates.frames()),
        )
        return agent.update_step.lower(*shapes)

    def _physics_step(self) -> Callable[[], Any] | None:
        """Returns a step without rendering; None if the task observes images alone."""
        config = self.config.copy_and_resolve_references()
        with config.unlocked():
            config.observation = "state"
        try:
            environment = assembly.training_environment(config)
        except ValueError:
            return None
        self._closing.callback(environment.close)
        environment.reset(episode=0)
        action = np.zeros(environment.action_spec().shape)
        return lambda: environment.step(action)

    def _random_episode(self) -> Episode:
        environment = self._environment
        num_steps = environment.episode_steps
        rng = np.random.default_rng(self.config.seed)
        actions = rng.uniform(-1, 1, (num_steps, *environment.action_spec().shape))
        with told_as("the task", "an episode of random actions"):
            environment.reset(episode=0)
            frames = [environment.single_observation()]
            for action in actions[:_RENDERED_FRAMES]:
                environment.step(action)
                frames.append(environment.single_observation())
        return Episode(
            frames=np.stack([frames[i % len(frames)] for i in range(num_steps + 1)]),
            actions=actions.astype(np.float32),
            rewards=np.zeros(num_steps, np.float32),
            discounts=np.ones(num_steps, np.float32),
        )
