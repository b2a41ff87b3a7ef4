"""A policy that a run has learned, taken from its newest checkpoint."""

import pathlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.environments.suite import PixelEnvironment
from jaxil.errors import UsageError
from jaxil.learner.state import LearnerParams
from jaxil.training import agent as agents
from jaxil.training import assembly, workdir
from jaxil.training.checkpoint import CheckpointError, Checkpoints


class Trained(NamedTuple):
    """What it takes to play a learned policy.

    Attributes:
      config: the run's settings.
      environment: one of its own, apart from the training's.
      act: observation -> mean action.
      params: of encoder, actor and critic.
      demonstrations: what the run imitates; None without.
      frame: environment frames that the policy was trained for.
      episode: training episodes so far.
      seconds: wall-clock of the training.
    """

    config: Config
    environment: PixelEnvironment
    act: Callable[[np.ndarray], np.ndarray]
    params: LearnerParams
    demonstrations: loading.Demonstrations | None
    frame: int
    episode: int
    seconds: float

    def description(self) -> str:
        """Says in a few words how the policy came to be."""
        config = self.config
        return (
            f"{config.method} learner on {config.observation}, seed {config.seed}, "
            f"{self.frame} frames, {self.seconds / 60:.0f} minutes of training"
        )


def load(folder: pathlib.Path) -> Trained:
    """Reads the newest whole checkpoint of a run; the run may be going on.

    Args:
      folder: `--workdir` of the run.

    Raises:
      UsageError: there is no run, no checkpoint, or it can't be read.
    """
    config = workdir.read_config(folder)
    faults = assembly.problems(config)
    if faults:
        raise UsageError(f"{folder / 'config.json'}: {'; '.join(map(str, faults))}")
    environment = assembly.evaluation_environment(config)
    demonstrations = assembly.load_demonstrations(config)
    agent = agents.make_agent(config, environment, demonstrations)
    try:
        state, counters = Checkpoints(folder).restore(agents.abstract_state(agent))
    except CheckpointError as error:
        raise UsageError(str(error)) from error
    encoder, actor, _ = state.params

    def act(observation: np.ndarray) -> np.ndarray:
        return np.asarray(agent.mean_action(encoder, actor, observation[None]))[0]

    return Trained(
        config=config,
        environment=environment,
        act=act,
        params=state.params,
        demonstrations=demonstrations,
        frame=counters["num_steps"] * config.action_repeat,
        episode=counters["num_episodes"],
        seconds=counters["seconds"],
    )
