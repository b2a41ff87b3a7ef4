"""The policy in a run's newest checkpoint."""

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
    """A learned policy and its environment."""

    config: Config
    environment: PixelEnvironment  # a separate one, not the training's
    act: Callable[[np.ndarray], np.ndarray]  # observation -> mean action
    params: LearnerParams
    demonstrations: loading.Demonstrations | None
    frame: int  # environment frames of training
    episode: int  # training episodes
    seconds: float  # wall clock of the training

    def description(self) -> str:
        """Returns a short description of the training."""
        config = self.config
        return (
            f"{config.method} learner on {config.observation}, seed {config.seed}, "
            f"{self.frame} frames, {self.seconds / 60:.0f} minutes of training"
        )


def load(folder: pathlib.Path) -> Trained:
    """Reads the newest whole checkpoint of a run, which may still be running.

    Args:
      folder: `--workdir` of the run.

    Raises:
      UsageError: there is no run, no checkpoint, or none can be read.
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
