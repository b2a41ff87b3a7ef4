"""Episodes of many lengths, for functions that are compiled for a few.

Every shape of an argument is compiled for seconds, and episodes that may end early have
hundreds of lengths.
"""

from typing import Any

import numpy as np

from jaxil.maths.types import Episode, PaddedEpisode

_SMALLEST = 8


def padded_length(num_steps: int, longest: int) -> int:
    """Returns the length to which an episode is padded: 8, 12, 16, 24, 32, 48, ...

    Whole episodes, of `longest` steps, are not padded, nor are longer ones.
    """
    if num_steps >= longest:
        return num_steps
    size = _SMALLEST
    while size < num_steps:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return min(size, longest)


def pad_rows(values: Any, num_rows: int) -> np.ndarray:
    """Repeats the last row of an array until it has this many rows."""
    values = np.asarray(values)
    missing = num_rows - len(values)
    if not missing:
        return values
    return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])


def pad_episode(episode: Episode, length: int) -> PaddedEpisode:
    """Repeats an episode's last frame, action, reward and discount, up to a length."""
    frames, *others = episode
    return PaddedEpisode(
        pad_rows(frames, length + 1),
        *(pad_rows(values, length) for values in others),
        num_steps=np.int32(episode.num_steps),
    )
