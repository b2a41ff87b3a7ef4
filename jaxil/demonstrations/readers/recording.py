"""What every reader of foreign files returns, and the faults that it may find."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np


class FormatError(ValueError):
    """A file is not what it should be.

    Its text is the end of a sentence that begins with the file's name, such as "is cut
    off after 3 of 10 episodes".
    """


class PixelEpisode(NamedTuple):
    """One episode as a file holds it, frames not stacked.

    Attributes:
      frames: uint8 [N + 1, H, W, 3], N >= 1; of any size.
      actions: what was done after frame t, float32 [N, A]; None where the file has
        none.
      rewards: what arrived with frame t + 1, float32 [N]; None where the file has none.
    """

    frames: np.ndarray
    actions: np.ndarray | None = None
    rewards: np.ndarray | None = None


class Recording(NamedTuple):
    """An opened file: what it says of itself, and its episodes.

    Attributes:
      kind: the format's name, for people.
      num_episodes: at least 1.
      episodes: yields them in order, reading each when it is asked for, so that memory
        holds one at a time; raises FormatError where one is damaged.
      task: `domain_task`; None where the file doesn't say.
      action_repeat: environment frames per stored step; None where it doesn't say.
      frames_per_second: of the stored frames; None where it doesn't say.
      notes: what a user should know before trusting the data, as whole sentences.
    """

    kind: str
    num_episodes: int
    episodes: Iterator[PixelEpisode]
    task: str | None = None
    action_repeat: int | None = None
    frames_per_second: float | None = None
    notes: tuple[str, ...] = ()
