"""The rules that each episode of a foreign file has to keep, whatever its format."""

import numpy as np

from jaxil.demonstrations.readers.recording import FormatError, PixelEpisode


def check_episode(index: int, episode: PixelEpisode) -> None:
    """Raises FormatError unless shapes, types and numbers of an episode are right.

    Args:
      index: the episode's number, for the message.
      episode: as a reader returned it.
    """
    frames = episode.frames
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise FormatError(
            f"has frames of type {frames.dtype} and shape {frames.shape} in episode "
            f"{index}, where uint8 [N + 1, H, W, 3] is expected"
        )
    if len(frames) < 2 or 0 in frames.shape:
        raise FormatError(
            f"has {len(frames)} frames of {frames.shape[2]}x{frames.shape[1]} pixels "
            f"in episode {index}, where at least two of one pixel are needed"
        )
    num_steps = len(frames) - 1
    for name, values, num_axes in (
        ("actions", episode.actions, 2),
        ("rewards", episode.rewards, 1),
    ):
        if values is None:
            continue
        if values.ndim != num_axes or len(values) != num_steps:
            raise FormatError(
                f"has {name} of shape {values.shape} in episode {index}, which does "
                f"not fit {len(frames)} frames"
            )
        if values.dtype != np.float32 or not np.isfinite(values).all():
            raise FormatError(
                f"has {name} in episode {index} that are not finite float32 numbers"
            )
