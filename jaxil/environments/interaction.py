"""What the training loop needs of a simulator, and of several of them."""

from typing import NamedTuple, Protocol, runtime_checkable

import dm_env
import numpy as np
from dm_env import specs


@runtime_checkable
class Environment(Protocol):
    """One simulator; time runs in agent steps.

    A `PixelEnvironment` is one; implement these methods to train in another simulator.
    """

    @property
    def episode_steps(self) -> int | None:
        """Agent steps of a whole episode; None where only the task ends it."""
        ...

    def observation_spec(self) -> specs.Array:
        """Returns the spec of observations: uint8 [H, W, C] or float32 [S]."""
        ...

    def action_spec(self) -> specs.BoundedArray:
        """Returns the spec of actions: float32 [A] in [-1, 1]."""
        ...

    def reset(self, episode: int) -> dm_env.TimeStep:
        """Starts an episode, whose number alone fixes its start."""
        ...

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Applies an action; a time limit ends an episode with a discount of 1."""
        ...

    def single_observation(self) -> np.ndarray:
        """Returns the present frame, not stacked: uint8 [H, W, 3] or float32 [S]."""
        ...


class Moment(NamedTuple):
    """What an environment shows after a reset or a step.

    Attributes:
      observation: what the policy sees. uint8 [H, W, C] or float32 [S].
      frame: the present alone, as a replay stores it. uint8 [H, W, 3] or float32 [S].
      task_reward: summed over the action repeat; 0 at a reset.
      discount: product over the action repeat; 1 at a reset, and at a time limit.
      is_last: whether the episode is over.
    """

    observation: np.ndarray
    frame: np.ndarray
    task_reward: float
    discount: float
    is_last: bool


class Environments(Protocol):
    """Several simulators that work while their user does something else."""

    size: int

    def reset(self, index: int, episode: int) -> None:
        """Sends one to the start of an episode."""
        ...

    def step(self, index: int, action: np.ndarray) -> None:
        """Sends it an action, shape [A]."""
        ...

    def receive(self, index: int) -> Moment | None:
        """Waits for the outcome; None if it was lost, and the episode with it."""
        ...

    def close(self) -> None:
        """Ends their processes."""
        ...
