"""The loop: act, store, reward, learn, look. Read it from top to bottom."""

import contextlib
import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from jaxil.config import METHODS, Config
from jaxil.demonstrations import loading
from jaxil.environments.evaluation import evaluate
from jaxil.environments.interaction import (
    Decision,
    FinishedEpisode,
    interact,
    interact_together,
    join,
)
from jaxil.environments.pool import EnvironmentsFailed
from jaxil.learner.state import TrainState
from jaxil.machine import screen
from jaxil.machine.progress import ProgressLine
from jaxil.machine.signals import StopOnSignals
from jaxil.maths.types import Episode
from jaxil.training import assembly, run_log
from jaxil.training.checkpoint import Checkpoints
from jaxil.training.expert_distance import Closeness
from jaxil.training.stopwatch import Stopwatch, TimedEnvironment, TimedPool
from jaxil.training.updates import Updates

# Names of NumPy's random streams: every draw is keyed by (seed, stream, step), so
# that a resumed run repeats those of an unbroken one without any stored state.
_UNIFORM_ACTIONS, _SAMPLED_BATCHES = 1, 2
_EXPLORATION_KEY = 2**32 - 2  # a fold_in number that no update has


class TrainingDiverged(RuntimeError):
    """A loss or reward is no longer a finite number."""


@dataclasses.dataclass
class Counters:
    """How far a run has come; saved with each checkpoint.

    Attributes:
      num_steps: decisions of the agent so far.
      num_episodes: whole episodes so far; a resumed run begins with this number.
      num_evals: evaluations so far.
      last_eval_step: decision of the last evaluation.
      last_checkpoint_step: decision of the last checkpoint.
      last_refresh_step: decision of the last recomputation of stored rewards.
      seconds: wall-clock of the run, earlier processes included.
    """

    num_steps: int = 0
    num_episodes: int = 0
    num_evals: int = 0
    last_eval_step: int = 0
    last_checkpoint_step: int = 0
    last_refresh_step: int = 0
    seconds: float = 0.0


class Run:
    """One training run: its parts, its state, and what happens to them in order."""

    def __init__(
        self,
        config: Config,
        workdir: pathlib.Path,
        demonstrations: loading.Demonstrations | None,
        say: Callable[[str], None],
    ) -> None:
        """Makes the parts and goes on from the newest checkpoint, if there is one."""
        self.config = config
        self.demonstrations = demonstrations
        self.say = say
        self.environment = assembly.training_environment(config)
        self.eval_environment = assembly.evaluation_environment(config)
        self.agent = assembly.make_agent(config, self.environment, demonstrations)
        self.replay = assembly.make_replay(config, self.environment)
        self.experts = assembly.expert_episodes(self.agent.rewarder, demonstrations)
        self.closeness = None
        if demonstrations is not None:
            self.closeness = Closeness(config, workdir, demonstrations)
        self.counters = Counters()
        self.checkpoints = Checkpoints(workdir, say=say)
        self.stopwatch = Stopwatch()
        self.metrics: dict[str, Any] = {}
        self.returns: dict[str, float] = {}  # of the last episode, for people
        self.decisions: dict[int, list[Decision]] = {}  # by episode under way
        self.stop_asked = False
        self.state: TrainState = self._restore_or_init()
        self.updates = Updates(
            config, self.agent, self.replay, demonstrations, self.experts
        )
        self.exploration_key = jax.random.fold_in(
            jax.random.key(config.seed), _EXPLORATION_KEY
        )
        self.started = time.monotonic() - self.counters.seconds
        resumed = self.frame if self.counters.num_steps else None
        self.outputs = run_log.Outputs(workdir, config, demonstrations, resumed)
        self.progress = ProgressLine(config.total_frames, first_frame=self.frame)
        self.pool = assembly.training_pool(
            config, self.environment, lambda text: self.say(text)
        )

    @property
    def frame(self) -> int:
        """Environment frames so far."""
        return self.counters.num_steps * self.config.action_repeat

    def loop(self, *, whole_episodes: bool = True) -> None:
        """Trains until the budget is used up, or until someone asks to stop.

        `finish` has to follow.

        Args:
          whole_episodes: whether episodes that are under way when the budget ends are
            played to their end, so that they count and the last evaluation takes place.

        Raises:
          EnvironmentsFailed: there are several, and they can't go on.
          TrainingDiverged: losses or rewards are not finite any more.
        """
        config, counters = self.config, self.counters
        if config.method == "bc":
            self.clone()
            return
        self.decisions = {}
        rounds = self.rounds()
        while not self.stop_asked and (
            self.frame < config.total_frames or (whole_episodes and self.decisions)
        ):
            # Act; learn; observe.
            ended = []
            for decision in next(rounds):
                self.decisions.setdefault(decision.episode, []).append(decision)
                if decision.is_last:
                    ended.append(decision.episode)

            # Reward a finished episode, remember it, look at it.
            for place, episode in enumerate(ended):
                self.finish_episode(episode, later=ended[place + 1 :])
            if ended:
                if self.is_due(counters.last_eval_step, config.eval_every_frames):
                    self.evaluate()
                if self.is_due(
                    counters.last_checkpoint_step, config.checkpoint_every_frames
                ):
                    self.save()
            self.progress.update(self.frame, self.stopwatch.seconds, self.returns)
        self.stopwatch.timed("update", self.flush)()

    def rounds(self) -> Iterator[list[Decision]]:
        """Returns the next decision of each environment, again and again."""
        update = functools.partial(self.stopwatch.timed, "update")
        if self.pool is not None:
            return interact_together(
                TimedPool(self.pool, self.stopwatch),
                update(self.act_together),
                first_episode=self.counters.num_episodes,
                begin=self.begin_episode,
                meanwhile=self.learn,
            )
        decisions = interact(
            TimedEnvironment(self.environment, self.stopwatch),
            update(self.act),
            first_episode=self.counters.num_episodes,
            meanwhile=self.learn,
        )
        return ([decision] for decision in decisions)

    def begin_episode(self, episode: int) -> bool:
        """Says whether one of several environments shall play an episode.

        It shall if the budget has room for it beside those under way: so a run has as
        many episodes as with one environment. One that was lost is played again.
        """
        length = self.environment.episode_steps or 0
        left = sum(max(length - len(played), 0) for played in self.decisions.values())
        planned = self.frame + left * self.config.action_repeat
        if planned >= self.config.total_frames and episode not in self.decisions:
            return False
        self.decisions[episode] = []
        return True

    def learn(self) -> None:
        """Counts a decision and starts the learner's step, where one is due.

        Between the action and its observation: jax only starts the update here, which
        then computes while the simulator does. The next action waits for it, so that
        the policy of a single environment never lags.
        """
        self.counters.num_steps += 1
        if self.update_is_due():
            self.stopwatch.timed("update", self.update)()

    def clone(self) -> None:
        """Trains on the demonstrations alone, without playing.

        Frames go on as if an update took as many of them as in other methods, so that
        curves of as many updates have the same length.
        """
        config, counters = self.config, self.counters
        while not self.stop_asked and self.frame < config.total_frames:
            counters.num_steps += config.update_every_steps
            self.stopwatch.timed("update", self.update)()
            if self.is_due(counters.last_eval_step, config.eval_every_frames):
                self.flush()
                counters.seconds = time.monotonic() - self.started
                metrics = {name: float(value) for name, value in self.metrics.items()}
                self.require_finite(metrics)
                self.outputs.updates(
                    frame=self.frame, seconds=counters.seconds, metrics=metrics
                )
                self.evaluate()
            if self.is_due(
                counters.last_checkpoint_step, config.checkpoint_every_frames
            ):
                self.save()
            self.progress.update(self.frame, self.stopwatch.seconds, self.returns)

    def ask_to_stop(self, who: str) -> bool:
        """Makes the loop end after this decision; False if it was asked before."""
        if self.stop_asked:
            return False
        self.stop_asked = True
        self.progress.message(f"{who}: saving; once more ends at once, unsaved")
        return True

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Returns an exploring action; uniform at first."""
        num_steps = self.counters.num_steps
        if num_steps < self.config.exploration_steps:
            return self._uniform_action(num_steps)
        # The state is donated at each update: its parameters are read afresh.
        encoder, actor, _ = self.state.params
        return np.asarray(
            self.agent.explore(
                encoder,
                actor,
                observation,
                self.exploration_key,
                np.uint32(num_steps),
            )
        )

    def act_together(self, observations: np.ndarray) -> np.ndarray:
        """Returns exploring actions [E, A] of one policy, each with its own noise.

        Args:
          observations: one of each environment that plays, [E, ...].
        """
        count, size = len(observations), self.config.num_environments
        steps = self.counters.num_steps + np.arange(size, dtype=np.uint32)
        uniform = steps[:count] < self.config.exploration_steps
        actions = np.empty((count, *self.environment.action_spec().shape), np.float32)
        for place in np.flatnonzero(uniform):
            actions[place] = self._uniform_action(int(steps[place]))
        if not uniform.all():
            # Of one size, though fewer may play at the end: it is compiled once.
            padded = np.zeros((size, *observations.shape[1:]), observations.dtype)
            padded[:count] = observations
            encoder, actor, _ = self.state.params
            explored = self.agent.explore_together(
                encoder, actor, padded, self.exploration_key, steps
            )
            actions[~uniform] = np.asarray(explored)[:count][~uniform]
        return actions

    def update_is_due(self) -> bool:
        """Says whether the learner steps after this decision."""
        return (
            self.frame >= self.config.seed_frames
            and self.counters.num_steps % self.config.update_every_steps == 0
            and self.replay.can_sample()
        )

    def update(self) -> None:
        """Draws a batch, and learns where enough of them are together."""
        rng = self._rng(_SAMPLED_BATCHES, self.counters.num_steps)
        if self.updates.collect(rng):
            self.flush()

    def flush(self) -> None:
        """Makes the updates that are due and not made yet."""
        self.state, metrics = self.updates.run(self.state)
        if metrics is not None:
            self.metrics = metrics

    def finish_episode(self, number: int, *, later: Sequence[int] = ()) -> None:
        """Rewards a finished episode once, and stores it for good.

        Args:
          number: of the episode.
          later: those that ended in the same round and are finished after it. In the
            table they stand as if played one after the other, in equal times.
        """
        episode = join(self.decisions.pop(number))
        later_steps = sum(len(self.decisions[each]) for each in later)
        # Updates may not see an episode that entered after they were due, and rewards
        # are to come from all that was learned; their own clock starts after it.
        self.stopwatch.timed("update", self.flush)()
        self.stopwatch.timed("update", jax.block_until_ready)(self.state.num_updates)
        start = time.perf_counter()
        rewards = self.reward(episode)
        self.replay.add_episode(
            frames=episode.frames,
            actions=episode.actions,
            rewards=rewards,
            discounts=episode.discounts,
        )
        self.updates.episode_added()
        if self.refresh_is_due():
            self.updates.refresh_rewards(self.state)
            self.counters.last_refresh_step = self.counters.num_steps
        self.stopwatch.reward_seconds += time.perf_counter() - start
        self.stopwatch.seconds["update"] += time.perf_counter() - start
        metrics = {name: float(value) for name, value in self.metrics.items()}
        metrics |= {
            name: float(value)
            for name, value in self.agent.rewarder.summary(self.state.rewarder).items()
        }
        metrics["replay/reward"] = self.replay.mean_reward()
        self.require_finite(metrics)
        since_last_row = time.monotonic() - self.started - self.counters.seconds
        self.counters.seconds += since_last_row / (1 + len(later))
        self.returns = {
            "task": float(np.sum(episode.task_rewards)),
            "imitation": float(np.sum(rewards)),
        }
        self.outputs.episode(
            frame=self.frame - later_steps * self.config.action_repeat,
            seconds=self.counters.seconds,
            episode=self.counters.num_episodes,
            task_return=self.returns["task"],
            imitation_return=self.returns["imitation"],
            length=len(rewards),
            reward_seconds=self.stopwatch.reward_seconds,
            metrics=metrics,
        )
        self.counters.num_episodes += 1

    def reward(self, episode: FinishedEpisode) -> np.ndarray:
        """Returns the rewarder's rewards [T]; its state moves on."""
        rewards, rewarder = self.agent.rewards(
            self.state.rewarder, self.state.params, _seen(episode), self.experts
        )
        self.state = self.state.replace(rewarder=rewarder)
        self.require_finite({"imitation reward": float(np.sum(rewards))})
        return np.asarray(rewards)

    def refresh_is_due(self) -> bool:
        """Says whether all stored rewards are to be recomputed now."""
        every, counters = self.config.reward_refresh_steps, self.counters
        changed = self.agent.rewarder.rewards_changed
        if every == 0 or changed is None:
            return False
        passed = counters.num_steps - counters.last_refresh_step
        return passed >= every and bool(changed(self.state.rewarder))

    def require_finite(self, values: dict[str, float]) -> None:
        """Raises TrainingDiverged where a number is not finite."""
        bad = [name for name, value in values.items() if not np.isfinite(value)]
        if bad:
            raise TrainingDiverged(
                f"{', '.join(bad)} became infinite or NaN by frame {self.frame} "
                f"(update {int(self.state.num_updates)}). Last good checkpoint: "
                f"{self.newest_checkpoint()}. Lower learning_rate, or see in train.csv "
                "what grew before"
            )

    def newest_checkpoint(self) -> str:
        """Returns a few words on it, for people."""
        frame = self.checkpoints.newest()
        return "there is none" if frame is None else f"that of frame {frame}"

    def evaluate(self) -> None:
        """Plays evaluation episodes with the mean action and writes them down."""
        config, counters = self.config, self.counters
        encoder, actor, _ = self.state.params
        every = config.video_every_evals
        evaluation = evaluate(
            self.eval_environment,
            lambda o: np.asarray(self.agent.exploit(encoder, actor, o)),
            num_episodes=config.num_eval_episodes,
            first_episode=counters.num_evals * config.num_eval_episodes,
            record_video=every > 0
            and (counters.num_evals % every == 0 or self.frame >= config.total_frames),
        )
        distance = None
        if self.closeness is not None:
            distance = self.closeness.relative_distance(evaluation.episodes)
        filmed = {}
        if evaluation.video is not None:
            filmed = self.explain(evaluation.episodes[0])
        counters.num_evals += 1
        counters.last_eval_step = counters.num_steps
        counters.seconds = time.monotonic() - self.started
        self.say(
            self.outputs.evaluation(
                evaluation,
                self.frame,
                counters.seconds,
                counters.num_episodes,
                distance=distance,
                filmed=filmed,
            )
        )

    def explain(self, episode: FinishedEpisode) -> dict[str, np.ndarray]:
        """Returns what the method thinks of an episode, for people to look at.

        Returns:
          `task_rewards` [T], `imitation_rewards` [T], and the transport plan
          `plan` [T + 1, N + 1] of methods that have one.
        """
        arguments = (
            self.state.rewarder,
            self.state.params,
            _seen(episode),
            self.experts,
        )
        rewards, _ = self.agent.rewards(*arguments)
        found = {
            "task_rewards": episode.task_rewards,
            "imitation_rewards": np.asarray(rewards),
        }
        if self.agent.plan is not None:
            found["plan"] = np.asarray(self.agent.plan(*arguments))
        return found

    def is_due(self, last_step: int, every_frames: int) -> bool:
        """Says whether that many frames have gone by, or the run is at its end.

        Tested at episode ends only, hence "at least": a modulo might never be zero.
        """
        passed = (self.counters.num_steps - last_step) * self.config.action_repeat
        at_end = self.frame >= self.config.total_frames and not self.decisions
        return passed >= every_frames or at_end

    def save(self) -> None:
        """Writes a checkpoint: learner, counters, and the replay's new episodes."""
        self.flush()
        self.counters.last_checkpoint_step = self.counters.num_steps
        self.counters.seconds = time.monotonic() - self.started
        self.checkpoints.save(
            frame=self.frame,
            learner_state=self.state,
            counters=dataclasses.asdict(self.counters),
            replay=self.replay,
        )

    def finish(self) -> None:
        """Saves what is not saved yet; an unfinished episode is dropped."""
        self.progress.close()
        if self.counters.last_checkpoint_step != self.counters.num_steps:
            self.save()
        self.outputs.close()

    def close(self) -> None:
        """Ends the processes of several environments."""
        if self.pool is not None:
            self.pool.close()

    def _uniform_action(self, num_steps: int) -> np.ndarray:
        rng = self._rng(_UNIFORM_ACTIONS, num_steps)
        return rng.uniform(-1.0, 1.0, self.environment.action_spec().shape)

    def _rng(self, stream: int, num_steps: int) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, stream, num_steps])

    def _restore_or_init(self) -> TrainState:
        if self.checkpoints.newest() is None:
            return self.agent.init_state()
        state, counters = self.checkpoints.restore(
            assembly.abstract_state(self.agent), self.replay
        )
        self.counters = Counters(**counters)
        self.say(f"going on from the checkpoint of frame {self.frame}")
        return state


def _seen(episode: FinishedEpisode) -> Episode:
    return Episode(episode.frames, episode.actions, episode.task_rewards)


def train(config: Config, workdir: pathlib.Path) -> bool:
    """Trains a run to its end, or on to its end.

    Args:
      config: checked.
      workdir: the run's folder, opened by `workdir.opened`.

    Returns:
      Whether the budget is used up; False when someone asked to stop.

    Raises:
      DemonstrationError: the demonstrations can't serve this run.
      TrainingDiverged: losses or rewards are not finite any more.
      EnvironmentsFailed: there are several, and they can't go on.
    """

    def say(text: str) -> None:
        screen.say(text)

    demonstrations = assembly.load_demonstrations(config)
    say(f"{config.task}: {METHODS[config.method]}, seed {config.seed}")
    run = Run(config, workdir, demonstrations, say)
    run.say = run.progress.message
    with contextlib.closing(run), StopOnSignals(run.ask_to_stop):
        try:
            run.loop()
        except EnvironmentsFailed as error:
            raise EnvironmentsFailed(
                f"{error}\nNewest checkpoint: {run.newest_checkpoint()}. The same "
                "command goes on from it, or begins anew without one"
            ) from error
        run.finish()
    if run.stop_asked:
        say(f"stopped at frame {run.frame}, saved; the same command goes on from there")
    return not run.stop_asked
