"""What formats of stacked frames share: the newest picture, and numbers per step."""

import numpy as np

from jaxil.demonstrations.readers.recording import FormatError

_MAX_CHANNELS = 30  # ten frames; beyond that, an axis is a side of the picture


def newest_frames(observations: np.ndarray) -> np.ndarray:
    """Returns the newest picture of each stack.

    Sizes tell where the channels are: on the axis of 3, 6, 9, ... items, and if a side
    of the picture could be that too, on the shorter one.

    Args:
      observations: of n frames each, the newest last; uint8 [T, 3 n, H, W] or
        [T, H, W, 3 n].

    Returns:
      A copy. Shape [T, H, W, 3].

    Raises:
      FormatError: it has another type or shape, or one that can be read both ways.
    """
    shape = observations.shape
    if observations.dtype != np.uint8:
        raise FormatError(
            f"has observations of type {observations.dtype}, where uint8 is expected"
        )
    sizes = {axis: shape[axis] for axis in (1, 3) if len(shape) == 4}
    channels = {
        axis: size
        for axis, size in sizes.items()
        if 0 < size <= _MAX_CHANNELS and size % 3 == 0
    }
    if not channels:
        raise FormatError(
            f"has observations of shape {shape}, where coloured pictures are expected: "
            "[T, 3 n, H, W] or [T, H, W, 3 n]"
        )
    if len(set(channels.values())) < len(channels):
        raise FormatError(
            f"has observations of shape {shape}, which doesn't tell whether channels "
            "come first or last"
        )
    if min(channels, key=channels.__getitem__) == 1:
        observations = observations.transpose(0, 2, 3, 1)
    return np.array(observations[..., -3:], order="C")


def numbers_per_step(name: str, values: np.ndarray, num_axes: int) -> np.ndarray:
    """Returns actions [T, A] or rewards [T] as float32.

    Args:
      name: what they are, for the message.
      values: real numbers; rewards may have a last axis of one.
      num_axes: 2 for actions, 1 for rewards.

    Raises:
      FormatError: they are no numbers, or of another shape.
    """
    if num_axes == 1 and values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.dtype.kind not in "biuf" or values.ndim != num_axes:
        raise FormatError(
            f"has {name} of type {values.dtype} and shape {values.shape}, where "
            f"numbers on {num_axes} axes are expected"
        )
    with np.errstate(all="ignore"):  # too large a number becomes infinite
        return values.astype(np.float32)
