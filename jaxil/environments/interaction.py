"""What passes between environments, one or several in parallel, and who plays them."""

from typing import NamedTuple, Protocol

import numpy as np


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
