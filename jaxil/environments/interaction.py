"""What passes between environments, one or several in parallel, and who plays them."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Restorable(Protocol):
    """An environment whose simulator states can be stored, and rendered later."""

    def simulator_state(self) -> dict[str, np.ndarray]:
        """Returns the arrays that determine the simulator's state, by name."""
        ...

    def set_simulator_state(
        self, qpos: np.ndarray, qvel: np.ndarray, act: np.ndarray
    ) -> None:
        """Sets the simulation to a state from `simulator_state`."""


class Moment(NamedTuple):
    """The result of a reset or a step."""

    observation: np.ndarray  # the policy's input: uint8 [H, W, C] or float32 [S]
    frame: np.ndarray  # the newest, for the replay: uint8 [H, W, 3] or float32 [S]
    task_reward: float  # sum over the action repeat; 0 at a reset
    discount: float  # product over the action repeat; 1 at a reset or time limit
    is_last: bool


class Environments(Protocol):
    """One environment or several, whose steps `receive` waits for."""

    size: int  # how many there are

    def reset(self, index: int, episode: int) -> None:
        """Starts an episode in one environment."""

    def step(self, index: int, action: np.ndarray) -> None:
        """Sends it an action, shape [A]."""

    def receive(self, index: int) -> Moment | None:
        """Waits for the result; None if the environment and its episode are lost."""
        ...

    def close(self) -> None:
        """Closes them and ends their processes."""
