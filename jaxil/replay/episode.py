"""Checks of what is stored in the replay."""

import numpy as np

from jaxil.maths.types import Episode


def checked_episode(frames, actions, rewards, discounts, *, like: Episode) -> Episode:
    """Returns the arrays of an episode, converted to the dtypes of `like`.

    Frames are not converted. Only the first axis may differ from `like`.

    Raises:
      ValueError: for a wrong shape or dtype, or a number that is out of range.
    """
    frames = np.asarray(frames)
    shape, dtype = frames.shape, frames.dtype
    num_frames = len(frames) if frames.ndim > 0 else 0
    require(num_frames > 1, "frames.shape", shape, "at least two frames")
    expected = (num_frames, *like.frames.shape[1:])
    require(shape == expected, "frames.shape", shape, expected)
    require(dtype == like.frames.dtype, "frames.dtype", dtype, like.frames.dtype)
    _require_all(np.isfinite(frames), "frames", frames, "finite")

    def checked(name: str, values) -> np.ndarray:
        ring = getattr(like, name)
        shape = (num_frames - 1, *ring.shape[1:])
        return checked_values(name, values, np.empty(shape, ring.dtype))

    discounts = checked("discounts", discounts)
    in_range = (discounts >= 0) & (discounts <= 1)
    _require_all(in_range, "discounts", discounts, "in [0, 1]")
    return Episode(
        frames, checked("actions", actions), checked("rewards", rewards), discounts
    )


def checked_values(name: str, values, like: np.ndarray) -> np.ndarray:
    """Returns finite real numbers, converted to the dtype of `like`.

    Raises:
      ValueError: for a wrong shape or dtype, or a number that is not finite.
    """
    values = np.asarray(values)
    require(values.shape == like.shape, f"{name}.shape", values.shape, like.shape)
    real = values.dtype.kind in "fiu"
    require(real, f"{name}.dtype", values.dtype, "real numbers")
    with np.errstate(over="ignore"):  # it becomes inf, which is refused below
        values = values.astype(like.dtype)
    _require_all(np.isfinite(values), name, values, "finite")
    return values


def require(condition: bool, name: str, value: object, rule: object) -> None:
    """Raises a ValueError unless the condition holds."""
    if not condition:
        raise ValueError(f"{name} = {value}: expected {rule}")


def _require_all(good: np.ndarray, name: str, values: np.ndarray, rule: str) -> None:
    if not good.all():
        first = tuple(np.argwhere(~good)[0].tolist())
        require(False, f"{name}{list(first)}", values[first], rule)
