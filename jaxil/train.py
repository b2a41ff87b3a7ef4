"""The loop: act, learn, observe, reward, store, evaluate, save."""

import contextlib
import dataclasses
import pathlib
import time

import jax
import numpy as np

from jaxil import methods
from jaxil.config import Config
from jaxil.errors import EnvironmentsFailed, TrainingDiverged, told_as
from jaxil.machine import screen
from jaxil.machine.signals import StopOnSignals
from jaxil.maths.types import Episode
from jaxil.training import assembly
from jaxil.training.parts import Parts
from jaxil.training.run_log import When, as_floats

# NumPy's random streams. Numbers are keyed by (seed, stream, step), so a resumed run
# repeats those of an uninterrupted one without a stored state.
_UNIFORM_ACTIONS, _SAMPLED_BATCHES = 1, 2
_EXPLORATION_KEY = 2**32 - 2  # a fold_in number that no update has


@dataclasses.dataclass(eq=False)
class Run(Parts):
    """One training run: its parts, its state, and the loop over them."""

    def __post_init__(self) -> None:
        self.stop_asked = False
        self.returns: dict[str, float] = {}  # of the last episode, for the terminal
        self.started = time.monotonic() - self.counters.seconds
        self.exploration_key = jax.random.fold_in(
            jax.random.key(self.config.seed), _EXPLORATION_KEY
        )

    @property
    def frame(self) -> int:
        """Environment frames so far."""
        return self.counters.num_steps * self.config.action_repeat

    @property
    def now(self) -> When:
        """How far the run has come, for its tables."""
        seconds = time.monotonic() - self.started
        return When(self.frame, seconds, self.counters.num_episodes)

    @property
    def is_playing(self) -> bool:
        """Whether an episode has begun and not ended."""
        return self.player is not None and self.player.is_playing

    def loop(self, *, whole_episodes: bool = True) -> None:
        """Trains until the budget is used up, or until someone asks to stop.

        With `whole_episodes`, those that are open when the budget ends are played to
        their end, so that they are stored and the last evaluation takes place.

        Raises:
          EnvironmentsFailed: the task raised an error, or its processes keep dying.
          TrainingDiverged: a loss, a reward or an action is not finite any more.
        """
        config, counters, player = self.config, self.counters, self.player
        if counters.owes_evaluation:
            self.evaluate()
            self.save()
        # Collected updates run before a stop: to run fewer of them at once would change
        # what the agent does next.
        while not self.stop_asked or self.updates.is_pending:
            if player is not None:
                player.begin(self.wants_episode)
            is_spent = self.frame >= config.total_frames
            if is_spent and not (self.is_playing and whole_episodes):
                break
            if player is None:
                with self.stopwatch.timed("update"):
                    self.learn(config.update_every_steps)
                episodes = []
            else:
                with self.stopwatch.timed("update"):
                    actions = self.act(player.observations)
                player.step(actions)
                # The learner computes while the simulators step and render.
                with self.stopwatch.timed("update"):
                    self.learn(len(actions))
                episodes = player.observe()
            for episode in episodes:
                self.store(episode)
            if episodes or player is None:
                if self.is_due(counters.last_eval_step, config.eval_every_frames):
                    self.evaluate()
                every = config.checkpoint_every_frames
                if self.is_due(counters.last_checkpoint_step, every):
                    self.save()
            self.progress.update(self.frame, self.stopwatch.seconds, self.returns)
        with self.stopwatch.timed("update"):
            self.flush()

    def wants_episode(self) -> bool:
        """Returns whether the budget has room for an episode beside the open ones."""
        assert self.player is not None
        left = self.player.steps_left(self.episode_steps)
        return self.frame + left * self.config.action_repeat < self.config.total_frames

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Returns exploring actions [E, A] for observations [E, ...]."""
        count, size = len(observations), self.config.num_environments
        steps = self.counters.num_steps + np.arange(size, dtype=np.uint32)
        uniform = steps[:count] < self.config.exploration_steps
        shape = self.evaluator.environment.action_spec().shape
        actions = np.empty((count, *shape), np.float32)
        for index in np.flatnonzero(uniform):
            rng = self._rng(_UNIFORM_ACTIONS, int(steps[index]))
            actions[index] = rng.uniform(-1.0, 1.0, shape)
        if not uniform.all():
            # Padded to one size, to compile once: fewer may play at the end.
            padded = np.zeros((size, *observations.shape[1:]), observations.dtype)
            padded[:count] = observations
            # Each update donates the state, so its parameters are read anew.
            encoder, actor = self.state.newest_policy
            key = self.exploration_key
            sampled = self.agent.sample_action(encoder, actor, padded, key, steps)
            actions[~uniform] = np.asarray(sampled)[:count][~uniform]
            self.require_finite({"an action": float(np.sum(actions))})
        return actions

    def learn(self, num_steps: int) -> None:
        """Counts agent steps and starts the updates due, without waiting for them."""
        for _ in range(num_steps):
            before = self.frame
            self.counters.num_steps += 1
            if self.update_is_due(before):
                rng = self._rng(_SAMPLED_BATCHES, self.counters.num_steps)
                for _ in range(self.config.updates_per_step):
                    if self.updates.collect(rng):
                        self.flush()

    def update_is_due(self, before: int) -> bool:
        """Returns whether an agent step is followed by an update.

        That depends on the frames `before` it.
        """
        if self.counters.num_steps % self.config.update_every_steps:
            return False
        if self.player is None:
            return True
        return before >= self.config.seed_frames and self.replay.can_sample()

    def flush(self) -> None:
        """Makes the updates that are collected."""
        self.state, metrics = self.updates.run(self.state)
        if metrics is not None:
            self.counters.metrics = metrics

    def store(self, episode: Episode) -> None:
        """Rewards a finished episode and stores it; refreshes rewards where due."""
        with self.stopwatch.timed("update"):
            # Updates may not see an episode that is stored after they were due, and
            # rewards come from all that was learned. Their clock starts after that.
            self.flush()
            jax.block_until_ready(self.state.num_updates)
            start = time.perf_counter()
            rewards = self.reward(episode)
            with told_as("the task", "an episode"):  # its states may not be finite
                self.replay.add_episode(**episode._replace(rewards=rewards)._asdict())
            self.updates.episode_added()
            self.refresh_if_due()
            self.stopwatch.reward_seconds += time.perf_counter() - start
        summary = self.agent.rewarder.summary(self.state.rewarder)
        metrics = as_floats(self.counters.metrics | summary)
        metrics["replay/reward"] = self.replay.mean_reward()
        self.require_finite(metrics)
        rewards_by_kind = {"task": episode.rewards, "imitation": rewards}
        self.returns = as_floats({n: np.sum(r) for n, r in rewards_by_kind.items()})
        row = {
            "task_return": self.returns["task"],
            "imitation_return": self.returns["imitation"],
            "length": len(rewards),
            "reward_seconds": round(self.stopwatch.reward_seconds, 3),
            **metrics,
        }
        self.log.episode(self.now, row)
        self.counters.num_episodes += 1

    def reward(self, episode: Episode) -> np.ndarray:
        """Returns the method's rewards [T] of a finished episode, which it observes."""
        arguments = (self.state.params, episode, self.experts)
        rewarder = self.agent.observe(self.state.rewarder, *arguments)
        self.state = self.state.replace(rewarder=rewarder)
        rewards = np.asarray(self.agent.rewards(rewarder, *arguments))
        same = np.array_equal(rewards, episode.rewards, equal_nan=True)
        name = "the task's reward" if same else "imitation reward"
        self.require_finite({name: float(np.sum(rewards))})
        return rewards

    def refresh_if_due(self) -> None:
        """Recomputes all stored rewards if they are stale and it is time to."""
        every, counters = self.config.reward_refresh_steps, self.counters
        changed = self.agent.rewarder.rewards_changed
        if not every or changed is None:
            return
        counters.rewards_are_stale |= bool(changed(self.state.rewarder))
        passed = counters.num_steps - counters.last_refresh_step
        if passed >= every and counters.rewards_are_stale:
            self.updates.refresh_rewards(self.state, self.require_finite)
            counters.last_refresh_step = counters.num_steps
            counters.rewards_are_stale = False

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

    def is_due(self, last_step: int, every_frames: int) -> bool:
        """Returns whether that many frames have passed, or the run is at its end.

        Tested at episode ends only, hence "at least": a modulo might never be zero.
        """
        passed = (self.counters.num_steps - last_step) * self.config.action_repeat
        at_end = self.frame >= self.config.total_frames and not self.is_playing
        return passed >= every_frames or at_end

    def evaluate(self) -> None:
        """Plays evaluation episodes with the mean action and writes them down."""
        self.flush()
        counters = self.counters
        if self.player is None and not counters.owes_evaluation:
            # No episode has written these.
            metrics = as_floats(counters.metrics)
            self.require_finite(metrics)
            self.log.updates(self.now, metrics)
        result = self.evaluator.evaluate(
            self.state,
            number=counters.num_evals,
            is_last=self.frame >= self.config.total_frames,
            stop_asked=lambda: self.stop_asked,
        )
        counters.owes_evaluation = result is None
        if result is None:  # stopped: the resumed run plays it
            return
        counters.num_evals += 1
        counters.last_eval_step = counters.num_steps
        pre_tanh = float(counters.metrics.get("actor/pre_tanh", np.nan))
        self.progress.message(self.log.evaluation(self.now, result, pre_tanh))

    def save(self) -> None:
        """Writes a checkpoint: learner, counters, open and new episodes."""
        self.flush()
        self.counters.last_checkpoint_step = self.counters.num_steps
        self.counters.seconds = self.now.seconds
        open_episodes = {} if self.player is None else self.player.open_episodes
        self.checkpoints.save(
            frame=self.frame,
            learner_state=self.state,
            counters={
                **vars(self.counters),
                "metrics": as_floats(self.counters.metrics),
                "open_episodes": {n: a.tolist() for n, a in open_episodes.items()},
            },
            replay=self.replay,
            mean_image=self.agent.mean_image,
        )

    @property
    def is_finished(self) -> bool:
        """Whether the budget is used up and evaluated."""
        is_spent = self.frame >= self.config.total_frames and not self.is_playing
        return is_spent and not self.counters.owes_evaluation

    def finish(self) -> None:
        """Saves what is not saved yet."""
        if self.counters.last_checkpoint_step != self.counters.num_steps:
            self.save()

    def close(self) -> None:
        """Ends the line and the loggers, and closes the environments."""
        with contextlib.ExitStack() as closing:
            closing.callback(self.evaluator.environment.close)
            if self.player is not None:
                closing.callback(self.player.close)
            closing.callback(self.log.close)
            closing.callback(self.progress.close)

    def ask_to_stop(self, who: str) -> bool:
        """Makes the loop end after this step; returns False if already asked to."""
        if self.stop_asked:
            return False
        self.stop_asked = True
        again = "press Ctrl-C again to quit without saving"
        self.progress.message(f"{who}: saving; {again}")
        return True

    def newest_checkpoint(self) -> str:
        """Describes the newest checkpoint in a few words, for messages."""
        frame = self.checkpoints.newest()
        return "there is none" if frame is None else f"that of frame {frame}"

    def _rng(self, stream: int, num_steps: int) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, stream, num_steps])


def train(config: Config, workdir: pathlib.Path) -> bool:
    """Trains a run to its end, from its newest checkpoint if there is one.

    Its folder must be open, see `workdir.opened`. Returns whether the budget is used
    up; False when someone asked to stop.

    Raises:
      DemonstrationError: the demonstrations do not fit this run.
      TrainingDiverged, EnvironmentsFailed: see `Run.loop`.
    """
    demonstrations = assembly.load_demonstrations(config)
    method = methods.get(config.method)
    screen.say(f"{config.task}: {method.label}, {method.about}; seed {config.seed}")
    run = Run.make(config, workdir, demonstrations)
    with contextlib.closing(run), StopOnSignals(run.ask_to_stop):
        try:
            run.loop()
        except EnvironmentsFailed as error:
            newest = f"Newest checkpoint: {run.newest_checkpoint()}"
            does = "start anew" if run.checkpoints.newest() is None else "resume"
            way_out = f"Rerun the same command to {does}"
            raise EnvironmentsFailed(f"{error}\n{newest}. {way_out}") from error
        run.finish()
    if run.is_finished and not run.state.num_updates:
        screen.say("nothing was learned: lower seed_frames or num_steps")
    ended, way_on = "finished", "raise --config.total_frames to train further"
    if not run.is_finished:
        ended, way_on = "stopped", "rerun the same command to resume"
    screen.say(f"{ended} at frame {run.frame}, saved; {way_on}")
    return run.is_finished
