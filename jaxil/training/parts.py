"""What a training run is made of, new or from its newest checkpoint."""

import contextlib
import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any, Self

import jax
import numpy as np

from jaxil.config import Config
from jaxil.demonstrations.loading import Demonstrations
from jaxil.environments.player import Player
from jaxil.learner.state import TrainState
from jaxil.machine.progress import ProgressLine
from jaxil.maths.types import ExpertEpisodes
from jaxil.replay.replay import Replay
from jaxil.training import agent as agents
from jaxil.training import assembly
from jaxil.training.agent import Agent
from jaxil.training.checkpoint import Checkpoints
from jaxil.training.evaluator import Evaluator
from jaxil.training.expert_distance import ExpertDistance
from jaxil.training.run_log import RunLog
from jaxil.training.stopwatch import Stopwatch, TimedEnvironments
from jaxil.training.updates import Updates


@dataclasses.dataclass
class Counters:
    """How far a run has come; saved with each checkpoint.

    Attributes:
      num_steps: agent steps so far.
      num_episodes: whole episodes so far.
      num_evals: evaluations so far.
      last_eval_step: agent step of the last evaluation.
      last_checkpoint_step: agent step of the last checkpoint.
      last_refresh_step: agent step of the last recomputation of stored rewards.
      rewards_are_stale: whether stored rewards have changed since.
      owes_evaluation: whether an evaluation was due when the run was stopped.
      metrics: of the last update; for the next row of train.csv.
      seconds: wall-clock of the run, earlier processes included.
    """

    num_steps: int = 0
    num_episodes: int = 0
    num_evals: int = 0
    last_eval_step: int = 0
    last_checkpoint_step: int = 0
    last_refresh_step: int = 0
    rewards_are_stale: bool = False
    owes_evaluation: bool = False
    metrics: dict[str, Any] = dataclasses.field(default_factory=dict)
    seconds: float = 0.0


@dataclasses.dataclass
class Parts:
    """What a run is made of.

    Attributes:
      config: checked.
      agent: the compiled functions.
      state: the learner's.
      counters: how far it has come.
      player: plays episodes; None for a method that does not.
      episode_steps: agent steps of a usual episode.
      replay: where finished episodes go.
      updates: samples batches and runs the learner's step.
      experts: demonstrations on the device, for methods that match whole episodes.
      evaluator: plays evaluations.
      checkpoints: of this run.
      log: tables, curve and videos.
      progress: the line on the terminal.
      stopwatch: where the time goes.
    """

    config: Config
    agent: Agent
    state: TrainState
    counters: Counters
    player: Player | None
    episode_steps: int
    replay: Replay
    updates: Updates
    experts: ExpertEpisodes | None
    evaluator: Evaluator
    checkpoints: Checkpoints
    log: RunLog
    progress: ProgressLine
    stopwatch: Stopwatch

    @classmethod
    def make(
        cls,
        config: Config,
        workdir: pathlib.Path,
        demonstrations: Demonstrations | None,
        say: Callable[[str], None],
    ) -> Self:
        """Returns a run's parts, as of its newest checkpoint if there is one.

        Args:
          config: checked.
          workdir: the run's folder.
          demonstrations: what the method imitates, or None.
          say: prints a line.
        """
        with contextlib.ExitStack() as opened:
            made = cls._make(config, workdir, demonstrations, say, opened)
            opened.pop_all()
        return made

    @classmethod
    def _make(
        cls,
        config: Config,
        workdir: pathlib.Path,
        demonstrations: Demonstrations | None,
        say: Callable[[str], None],
        opened: contextlib.ExitStack,
    ) -> Self:
        """Does what `make` does; `opened` closes the environments if that fails."""
        environment = assembly.training_environment(config)
        opened.callback(environment.close)
        agent = agents.make_agent(config, environment, demonstrations)
        replay = assembly.make_replay(config, environment)
        checkpoints = Checkpoints(workdir, say=say)
        counters, open_episodes = Counters(), {}
        resumed = checkpoints.newest() is not None
        if resumed:
            abstract_state = jax.eval_shape(agent.init_state)
            state, saved = checkpoints.restore(abstract_state, replay)
            open_episodes = {
                int(number): np.asarray(actions, np.float32)
                for number, actions in saved.pop("open_episodes", {}).items()
            }
            counters = Counters(**saved)
        else:
            state = agent.init_state()
        evaluated = assembly.evaluation_environment(config)
        opened.callback(evaluated.close)
        frame = counters.num_steps * config.action_repeat
        if resumed:
            say(f"resuming from the checkpoint of frame {frame}")
        stopwatch = Stopwatch()
        experts = agents.expert_episodes(agent.rewarder, demonstrations)
        distance = None
        if demonstrations is not None:
            distance = ExpertDistance(config, workdir, demonstrations)
        player = assembly.make_player(
            config,
            environment,
            first_episode=counters.num_episodes + len(open_episodes),
            open_episodes=open_episodes,
            timed=functools.partial(TimedEnvironments, stopwatch=stopwatch),
            say=say,
        )
        if player is not None:
            opened.callback(player.close)
        return cls(
            config=config,
            agent=agent,
            state=state,
            counters=counters,
            episode_steps=environment.episode_steps,
            player=player,
            replay=replay,
            updates=Updates(config, agent, replay, demonstrations, experts),
            experts=experts,
            evaluator=Evaluator(config, agent, evaluated, experts, distance),
            checkpoints=checkpoints,
            log=RunLog(
                workdir,
                config,
                demonstrations,
                frame if resumed else None,
                owes_evaluation=counters.owes_evaluation,
            ),
            progress=ProgressLine(
                config.total_frames, first_frame=frame, steady_from=config.seed_frames
            ),
            stopwatch=stopwatch,
        )
