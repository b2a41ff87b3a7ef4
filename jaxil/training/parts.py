"""What a training run is made of, new or from its newest checkpoint."""

import contextlib
import dataclasses
import pathlib
from typing import Any, Self

import jax
import numpy as np

from jaxil.config import Config
from jaxil.demonstrations.loading import Demonstrations
from jaxil.environments.player import Player
from jaxil.learner.state import TrainState
from jaxil.machine import screen
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
from jaxil.training.stopwatch import Stopwatch
from jaxil.training.updates import Updates


@dataclasses.dataclass
class Counters:
    """How far a run has come; saved with each checkpoint."""

    num_steps: int = 0  # agent steps
    num_episodes: int = 0  # whole ones
    num_evals: int = 0
    last_eval_step: int = 0  # agent step, like the next two
    last_checkpoint_step: int = 0
    last_refresh_step: int = 0  # when stored rewards were last recomputed
    rewards_are_stale: bool = False  # whether they would differ if recomputed now
    owes_evaluation: bool = False  # whether one was due when the run was stopped
    # Of the last update; for the next row of train.csv.
    metrics: dict[str, Any] = dataclasses.field(default_factory=dict)
    seconds: float = 0.0  # of the run, earlier processes included


@dataclasses.dataclass
class Parts:
    """What a run is made of."""

    config: Config
    agent: Agent
    state: TrainState
    counters: Counters
    player: Player | None  # None for a method that plays no episodes
    episode_steps: int  # agent steps of a usual episode
    replay: Replay
    updates: Updates
    experts: ExpertEpisodes | None  # for methods that match whole episodes
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
    ) -> Self:
        """Returns the parts of the run in `workdir`, as of its newest checkpoint."""
        with contextlib.ExitStack() as opened:  # closed again if the rest fails
            environment = assembly.training_environment(config)
            opened.callback(environment.close)
            agent = agents.make_agent(config, environment, demonstrations)
            replay = assembly.make_replay(config, environment)
            checkpoints = Checkpoints(workdir)
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
                screen.say(f"resuming from the checkpoint of frame {frame}")
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
                stopwatch=stopwatch,
            )
            if player is not None:
                opened.callback(player.close)
            made = cls(
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
                    config.total_frames,
                    first_frame=frame,
                    steady_from=config.seed_frames,
                ),
                stopwatch=stopwatch,
            )
            opened.pop_all()
        return made
