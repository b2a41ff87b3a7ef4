"""What a run asks of its demonstrations, and what it gets."""

from typing import Any, NamedTuple

import numpy as np

from jaxil.files import archive


class Wanted(NamedTuple):
    """What a run needs of its demonstrations, and how a file is read."""

    task: str  # such as "walker_walk"
    num_episodes: int = 10  # the file's first ones
    # The agent's, a multiple of the one in a file of states. Rewards of merged steps
    # are summed, and the first action is kept.
    action_repeat: int = 2
    max_episode_frames: int = 0  # of the agent's episodes; 0: the task's own limit
    image_size: int = 84  # height and width of the frames
    observation: str = "pixels"  # or "state"
    # The others, but for the last two, are of files of pixels.
    frame_skip: int = 1  # keeps every n-th frame
    sampling: str = "frames"  # "time" takes the frame nearest to each agent step
    fit: str = "stretch"  # or "crop" or "pad": how other shapes become squares
    dataset_camera: str = ""  # of a dataset with several
    stated_action_repeat: int = 0  # if the file does not say it; 0 if unknown
    takes_fewer: bool = False  # whether fewer episodes will do
    max_bytes: int = archive.MAX_BYTES  # of all arrays together


class Demonstrations(NamedTuple):
    """K expert episodes, frames not stacked, padded to the longest."""

    # uint8 [K, N + 1, H, W, 3], or float32 [K, N + 1, S] of observed states; padded
    # with the last frame.
    frames: np.ndarray
    num_frames: np.ndarray  # without padding. Shape [K]
    actions: np.ndarray | None  # float32 [K, N, A]; None if unknown
    task_rewards: np.ndarray | None  # float32 [K, N], for logs; None if unknown
    # The file's, and for the steps above `file`, the path; `action_repeat`, None if
    # unknown; and `returns`, one per episode, or an empty list if unknown.
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
