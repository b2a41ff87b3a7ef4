"""A run on the bench: whole, but its parts are called out of their order."""

import dataclasses
import io
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil import train
from jaxil.config import Config
from jaxil.environments.evaluation import evaluate
from jaxil.environments.interaction import FinishedEpisode
from jaxil.learner.gathering import gather_batch, gather_expert
from jaxil.machine.progress import ProgressLine
from jaxil.maths.types import Batch, ExpertBatch
from jaxil.timing.parts import make_parts
from jaxil.training import assembly

_EPISODE_STEPS = 500  # of tasks that have no limit of their own
_DRAWN_FRAMES = 20  # of a made-up episode; 500 take longer than all else here


class _LoopOnly(train.Run):
    """A run whose loop neither evaluates nor saves: both are timed by themselves.

    Attributes:
      waits: whether the environment waits for each update.
    """

    waits = False

    def update(self) -> None:
        super().update()
        if self.waits:
            jax.block_until_ready(self.state.num_updates)

    def begin_episode(self, episode: int) -> bool:
        # Its budget is a few decisions, less than an episode has.
        return True

    def evaluate(self) -> None:
        pass

    def save(self) -> None:
        pass


@dataclasses.dataclass
class Bench:
    """A run that has updated once, and what its parts work on.

    Attributes:
      run: its loop acts and learns from the first decision on.
      episode: of random actions.
      batches: of the agent and of the experts, on the host, as an update takes them.
      first_update_seconds: its compilation included.
    """

    run: _LoopOnly
    episode: FinishedEpisode
    batches: tuple[Batch | None, ExpertBatch | None]
    first_update_seconds: float

    def add_episode(self) -> None:
        """Stores the episode as a run does at its end."""
        episode = self.episode
        self.run.replay.add_episode(
            frames=episode.frames,
            actions=episode.actions,
            rewards=episode.task_rewards,
            discounts=episode.discounts,
        )
        self.run.updates.episode_added()

    def fill_replay(self) -> None:
        """Stores the episode until the replay is full, then learns from all of it."""
        run = self.run
        for _ in range(run.config.replay_size_steps // len(self.episode.actions) + 1):
            self.add_episode()
        batches = run.updates.draw(np.random.default_rng(0))
        step = run.agent.update_step
        run.state, _ = step(run.state, *batches, run.updates.frames())
        jax.block_until_ready(run.state)

    def update(self, batches: Any) -> Any:
        """Learns from as many batches as a run sends to the device at once.

        Args:
          batches: on the device; with one axis more if they are several.
        """
        run = self.run
        several = run.config.updates_per_dispatch > 1
        step = run.agent.repeated_step if several else run.agent.update_step
        run.state, run.metrics = step(run.state, *batches, self.run.updates.frames())
        return run.state

    def dispatched(self) -> Any:
        """Returns the batches that `update` takes, on the host."""
        times = self.run.config.updates_per_dispatch
        if times == 1:
            return self.batches
        return jax.tree.map(lambda leaf: np.stack([leaf] * times), self.batches)

    def loop(self, steps: int, *, waits: bool) -> float:
        """Acts and learns for so many decisions; returns seconds.

        Args:
          steps: of all environments together.
          waits: whether environments stand still while the learner updates.
        """
        run = self.run
        run.waits = waits
        with run.config.unlocked():
            run.config.total_frames = run.frame + steps * run.config.action_repeat
        begin = time.perf_counter()
        run.loop(whole_episodes=False)
        # The last update may still run in the background: it is an update's time.
        run.stopwatch.timed("update", jax.block_until_ready)(run.state.num_updates)
        return time.perf_counter() - begin

    def update_parts(self) -> dict[str, Callable[[], Any]]:
        """Returns the parts of an update; see `make_parts`."""
        run, config = self.run, self.run.config
        batch, expert = jax.device_put(self.batches)
        frames = self.run.updates.frames()
        if frames is not None and batch is not None:
            batch = jax.jit(gather_batch)(frames.agent, batch)
        if frames is not None and expert is not None:
            expert = jax.jit(gather_expert)(frames.expert, expert)
        mean = assembly.mean_image(config, run.demonstrations)
        return make_parts(
            assembly.make_networks(config, self.episode.actions.shape[1], mean),
            run.agent.rewarder,
            # Of its own, because each update deletes the state that it was given.
            jax.tree.map(jnp.copy, run.state),
            batch,
            expert,
            learning_rate=config.learning_rate,
            critic_target_tau=config.critic_target_tau,
            noise_clip=config.noise_clip,
            shift_padding=config.shift_padding,
        )

    def lower_update(self) -> Any:
        """Traces one update anew, for the compiler."""
        return self._lower(self.run.agent.update_step)

    def lower_plain_update(self) -> Any:
        """Traces one update with XLA's convolutions, whose operations XLA can count."""
        run = self.run
        config = run.config.copy_and_resolve_references()
        with config.unlocked():
            config.encoder.convolutions = "xla"
        agent = assembly.make_agent(config, run.environment, run.demonstrations)
        return self._lower(agent.update_step)

    def _lower(self, step: Any) -> Any:
        shapes = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype),
            (self.run.state, *self.batches, self.run.updates.frames()),
        )
        return step.lower(*shapes)

    def play_evaluation(self) -> None:
        """Plays one episode as an evaluation does, without its video."""
        run = self.run
        encoder, actor, _ = run.state.params
        evaluate(
            run.eval_environment,
            lambda o: np.asarray(run.agent.exploit(encoder, actor, o)),
            num_episodes=1,
            first_episode=0,
        )

    def save(self) -> None:
        """Writes a checkpoint with one new episode."""
        self.add_episode()
        train.Run.save(self.run)


def make_bench(
    config: Config,
    folder: pathlib.Path,
    demonstrations: Any,
    *,
    say: Callable[[str], None],
) -> Bench:
    """Returns a run that has stored an episode and updated once.

    Args:
      config: checked.
      folder: of the run.
      demonstrations: of the config, or None.
      say: takes a line for people.
    """
    config = config.copy_and_resolve_references()
    with config.unlocked():
        # The loop shall act and learn from its first decision on.
        config.exploration_steps = 0
        config.seed_frames = config.action_repeat
        config.total_frames = config.action_repeat
    run = _LoopOnly(config, folder, demonstrations, say)
    # A benchmark prints its table only.
    run.progress = ProgressLine(config.total_frames, stream=io.StringIO())
    bench = Bench(run, _random_episode(run), (None, None), 0.0)
    bench.add_episode()
    bench.batches = run.updates.draw(np.random.default_rng(0))
    begin = time.perf_counter()
    jax.block_until_ready(bench.update(jax.device_put(bench.dispatched())))
    bench.first_update_seconds = time.perf_counter() - begin
    if run.pool is not None:
        # Processes start and the policy of several compiles before any clock does.
        next(run.rounds())
        run.counters = train.Counters()
    return bench


def _random_episode(run: train.Run) -> FinishedEpisode:
    """Returns an episode of random actions, drawn only as far as needed."""
    environment = run.environment
    num_steps = environment.episode_steps or _EPISODE_STEPS
    rng = np.random.default_rng(run.config.seed)
    actions = rng.uniform(-1, 1, (num_steps, *environment.action_spec().shape))
    environment.reset(episode=0)
    frames = [environment.single_observation()]
    for action in actions[:_DRAWN_FRAMES]:
        environment.step(action)
        frames.append(environment.single_observation())
    frames = [frames[i % len(frames)] for i in range(num_steps + 1)]
    return FinishedEpisode(
        frames=np.stack(frames),
        actions=actions.astype(np.float32),
        task_rewards=np.zeros(num_steps, np.float32),
        discounts=np.ones(num_steps, np.float32),
    )
