"""What a task's own observation holds: images and numbers, in one array or many."""

from collections.abc import Mapping
from typing import Any

import numpy as np


def flat_state(observation: Any) -> np.ndarray:
    """Returns a task's own observation, without images, as float32 [S]."""
    flat = [np.ravel(part) for part in states_in(observation)]
    return np.concatenate(flat).astype(np.float32)


def images_in(observation: Any) -> list[np.ndarray]:
    """Returns its RGB images, arrays without composer's leading axis of length 1."""
    images = [part for part in _parts(observation) if is_image(part)]
    return [p[0] if isinstance(p, np.ndarray) and p.ndim == 4 else p for p in images]


def states_in(observation: Any) -> list[Any]:
    """Returns its arrays, or specs, that are no RGB images."""
    return [part for part in _parts(observation) if not is_image(part)]


def is_image(array: Any) -> bool:
    """Returns whether an array, or spec, is of uint8 [H, W, 3] or [1, H, W, 3]."""
    shape = getattr(array, "shape", ())
    shape = shape[1:] if len(shape) == 4 and shape[0] == 1 else shape
    return len(shape) == 3 and shape[2] == 3 and array.dtype == np.uint8


def described(observation: Any) -> str:
    """Returns types and shapes, for messages."""
    shown = [
        f"{part.dtype}{list(part.shape)}"
        if isinstance(part, np.ndarray)
        else type(part).__name__
        for part in _parts(observation)
    ]
    return ", ".join(shown) or "nothing"


def _parts(observation: Any) -> list[Any]:
    if not isinstance(observation, Mapping):
        return [observation]
    return [part for value in observation.values() for part in _parts(value)]
