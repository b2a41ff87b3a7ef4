"""The interfaces of one environment, and of several that run in parallel."""

from typing import NamedTuple, Protocol, runtime_checkable

import dm_env
import numpy as np
from dm_env import specs


@runtime_checkable
class Environment(Protocol):
    """What training and evaluation need of an environment, in agent steps.

    `PixelEnvironment` implements it for every kind of task. Tasks of dm_control are
    `Restorable` too.
    """

    @property
    def episode_steps(self) -> int:
        """Agent steps of a whole episode; longer ones are cut off."""
        ...

    @property
    def step_seconds(self) -> float | None:
        """Simulated duration of an agent step; None if unknown."""
        ...

    def observation_spec(self) -> specs.Array:
        """Returns the spec of observations: uint8 [H, W, C] or float32 [S]."""
        ...

    def action_spec(self) -> specs.BoundedArray:
        """Returns the spec of actions: float32 [A] in [-1, 1]."""
        ...

    def reset(self, episode: int) -> dm_env.TimeStep:
        """Starts an episode, whose number determines the initial state."""
        ...

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Applies an action; the discount is 1 at a time limit, 0 at a termination."""
        ...

    def single_observation(self) -> np.ndarray:
        """Returns the current frame, not stacked: uint8 [H, W, 3] or float32 [S]."""
        ...

    def frame(self) -> np.ndarray:
        """Returns the current image, uint8 [H, W, 3], for videos."""
        ...

    def renderer_name(self) -> str:
        """Returns a few words on what renders its images."""
        ...

    def close(self) -> None:
        """Frees the simulator."""


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
