"""What a run asks of its demonstrations, and what it gets."""

from typing import Any, NamedTuple

import numpy as np

from jaxil.files import archive


class Wanted(NamedTuple):
    """What a run needs of its demonstrations, and how a file is read.

    Attributes:
      task: such as "walker_walk".
      num_episodes: the file's first ones.
      action_repeat: the agent's; a multiple of the one in a file of states. Rewards of
        merged steps are summed, and the first action is kept.
      max_episode_frames: of the agent's episodes; 0: the task's own limit. A file whose
        episodes have another length is warned of.
      image_size: height and width of the frames.
      observation: "pixels" or "state".
      frame_skip: keeps every n-th frame of a file of pixels.
      sampling: of a file of pixels; "time" takes the frame nearest to each agent step.
      fit: "stretch", "crop" or "pad": how frames of other shapes become squares.
      dataset_camera: of a dataset with several.
      stated_action_repeat: of a file of pixels that does not say it; 0 if unknown.
      takes_fewer: whether fewer episodes will do; `loading` sets it where it is not
        given `num_episodes`.
      max_bytes: of all arrays together.
    """

    task: str
    num_episodes: int = 10
    action_repeat: int = 2
    max_episode_frames: int = 0
    image_size: int = 84
    observation: str = "pixels"
    frame_skip: int = 1
    sampling: str = "frames"
    fit: str = "stretch"
    dataset_camera: str = ""
    stated_action_repeat: int = 0
    takes_fewer: bool = False
    max_bytes: int = archive.MAX_BYTES


class Demonstrations(NamedTuple):
    """K expert episodes, frames not stacked, padded to the longest.

    Attributes:
      frames: uint8 [K, N + 1, H, W, 3], or float32 [K, N + 1, S] of observed states;
        padded with the last frame.
      num_frames: without padding. Shape [K].
      actions: float32 [K, N, A]; None if unknown.
      task_rewards: float32 [K, N], for logs; None if unknown.
      metadata: the file's, and for the steps above `file`, the path; `action_repeat`,
        None if unknown; and `returns`, one per episode, or an empty list if unknown.
    """

    frames: np.ndarray
    num_frames: np.ndarray
    actions: np.ndarray | None
    task_rewards: np.ndarray | None
    metadata: dict[str, Any]

    def mean_return(self) -> float | None:
        """Returns the mean task return; None if rewards are unknown."""
        returns = self.metadata["returns"]
        return float(np.mean(returns)) if returns else None


def returns_of(task_rewards: np.ndarray | None) -> list[float]:
    """Returns the sum of each episode's rewards [K, N]; empty if they are unknown."""
    if task_rewards is None:
        return []
    return np.asarray(task_rewards, np.float64).sum(axis=1).tolist()
