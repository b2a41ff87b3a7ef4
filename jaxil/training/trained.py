"""The policy in a run's newest checkpoint."""

import os
import pathlib
from typing import Any

import jax
import numpy as np
from flax.errors import FlaxError

from jaxil import config as jaxil_config
from jaxil import outside
from jaxil.config import Config
from jaxil.environments import tasks
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.errors import UsageError
from jaxil.learner.policy import make_mean_action
from jaxil.learner.state import LearnerParams
from jaxil.machine import devices
from jaxil.networks.agent import AgentNetworks
from jaxil.training import agent as agents
from jaxil.training import assembly, workdir
from jaxil.training.checkpoint import CheckpointError, Checkpoints


class Policy:
    """A learned policy: observations in, mean actions out.

    Attributes:
      config: of the run.
      frame: environment frames of training.
      seconds: wall-clock time of training.
      observation_shape: (H, W, 3 * frame_stack), frames stacked oldest first, or (S,).
      observation_dtype: uint8 for pixels, float32 for states.
      networks: the agent's modules.
      params: their parameters.
    """

    def __init__(
        self,
        config: Config,
        networks: AgentNetworks,
        params: LearnerParams,
        counters: dict[str, Any],
    ) -> None:
        """See `load_policy`."""
        self.config, self.networks, self.params = config, networks, params
        self.frame: int = counters["num_steps"] * config.action_repeat
        self.seconds: float = counters["seconds"]
        pixels = config.observation == "pixels"
        side, channels = config.image_size, 3 * config.frame_stack
        self.observation_dtype = np.uint8 if pixels else np.float32
        self.observation_shape: tuple[int, ...] = (side, side, channels)
        if not pixels:
            (layer,) = params.encoder["params"].values()
            self.observation_shape = layer["kernel"].shape[:1]
        self._act = jax.jit(make_mean_action(networks))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns the mean action, float32 [A] in [-1, 1], or [B, A] for a batch.

        Args:
          observation: `observation_shape`, or that behind a batch axis [B, ...].

        Raises:
          ValueError: it has another shape or type.
        """
        observation = np.asarray(observation)
        shape = self.observation_shape
        is_single = observation.shape == shape
        if observation.dtype != self.observation_dtype or (
            not is_single and observation.shape[1:] != shape
        ):
            raise ValueError(
                f"observation is {observation.dtype}{list(observation.shape)}: expected"
                f" {np.dtype(self.observation_dtype)}{list(shape)}, or a batch of them"
            )
        batch = observation[None] if is_single else observation
        actions = np.asarray(self._act(self.params.encoder, self.params.actor, batch))
        return actions[0] if is_single else actions

    def make_environment(self, seed: int = 0) -> PixelEnvironment:
        """Returns the task as the policy was trained on it.

        Raises:
          UsageError: the task is code that only the run's folder names.
        """
        if tasks.names_code(self.config.task):
            outside.require_trusted({"task": self.config.task}, "the run's folder")
        return assembly.environment_with_seed(self.config, seed)

    def description(self) -> str:
        """Returns a short description of the training."""
        config = self.config
        return (
            f"{config.method} learner on {config.observation}, seed {config.seed}, "
            f"{self.frame} frames, {self.seconds / 60:.0f} minutes of training"
        )


def load_policy(folder: str | os.PathLike) -> Policy:
    """Returns the policy of a run's newest whole checkpoint.

    The run may still be running. Neither its demonstrations nor the simulator are
    needed.

    Args:
      folder: `--workdir` of the run.

    Raises:
      UsageError: there is no run, no checkpoint, or none can be read.
    """
    folder = pathlib.Path(os.path.expanduser(folder))
    return _policy(folder, workdir.read_config(folder, imports_task=False))


def load(folder: pathlib.Path) -> tuple[Policy, PixelEnvironment]:
    """Returns the policy of a run with an environment for its evaluation.

    Raises:
      UsageError: see `load_policy`, or the task is code that only the folder names,
        or cannot be played here.
    """
    policy = _policy(folder, workdir.read_config(folder))
    if faults := assembly.task_problems(policy.config):
        raise UsageError(faults)
    environment = assembly.evaluation_environment(policy.config)
    head = policy.params.actor["params"]["head"]["output"]["bias"]
    for what, spec, shape in (
        ("observations", environment.observation_spec(), policy.observation_shape),
        ("actions", environment.action_spec(), head.shape),
    ):
        if spec.shape != shape:
            environment.close()
            why = f"{policy.config.task} has {what} {spec.shape}, the policy {shape}"
            raise _unfit(folder, why)
    return policy, environment


def _policy(folder: pathlib.Path, config: Config) -> Policy:
    devices.device_name()  # a wrong JAX_PLATFORMS is said first
    faults = jaxil_config.problems(config, known_tasks=(config.task,))
    if faults:
        raise UsageError(f"{folder / 'config.json'}: {'; '.join(map(str, faults))}")
    try:
        params, mean, counters = Checkpoints(folder).read_policy()
    except CheckpointError as error:
        raise UsageError(str(error)) from error
    if config.encoder.subtract_mean_image and mean is None:
        what = "the mean image that the encoder subtracts"
        raise UsageError(f"{folder}: the checkpoint lacks {what}")
    head = params["actor"]["params"]["head"]
    (action_dim,) = head["output"]["bias"].shape
    networks = agents.make_networks(config, action_dim, 0.5 if mean is None else mean)
    params = jax.tree.map(jax.numpy.asarray, params)
    try:
        policy = Policy(config, networks, LearnerParams(**params), counters)
        one = jax.ShapeDtypeStruct(
            (1, *policy.observation_shape), policy.observation_dtype
        )
        jax.eval_shape(policy._act, policy.params.encoder, policy.params.actor, one)
    except (FlaxError, TypeError, ValueError) as error:
        raise _unfit(folder, str(error)) from error
    return policy


def _unfit(folder: pathlib.Path, why: str) -> UsageError:
    words = f"does not fit the checkpoint ({why}); restore it"
    return UsageError(f"{folder / 'config.json'} {words}")
