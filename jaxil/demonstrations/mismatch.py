"""Warns where demonstrations differ from the agent's observations."""

import logging
import pathlib
from typing import Any

from jaxil.environments import suite, tasks
from jaxil.errors import printable

_RATE_TOLERANCE = 0.1  # relative, of a video's frame rate

_logger = logging.getLogger(__name__)


def warn_of_pixels(
    path: pathlib.Path,
    metadata: dict[str, Any],
    *,
    image_size: int,
    task: str,
    action_repeat: int,
) -> None:
    """Warns where a file of pixels differs from the agent's settings.

    `metadata` is that of the loaded `Demonstrations`.
    """
    size, (height, width) = image_size, metadata["stored_size"]
    messages = [
        f"{path} ({metadata['kind']}) holds pixels of another renderer: light, colours "
        "and camera may differ from the agent's."
    ]
    if (height, width) != (size, size):
        squeezed = "" if height == width else ", squeezed into a square"
        messages.append(
            f"{path}: frames of {width}x{height} pixels are resized to {size}x{size}"
            f"{squeezed}."
        )
    repeat = metadata["action_repeat"]
    if repeat is not None and repeat != action_repeat:
        messages.append(
            f"{path} was recorded with action_repeat={repeat}, but the run has "
            f"{action_repeat}: adjust action_repeat or demonstrations.frame_skip."
        )
    speed = metadata["frames_per_second"]
    seconds = tasks.decision_seconds(task, action_repeat)
    wanted = 1.0 / seconds if seconds else speed
    if speed and wanted and abs(speed / wanted - 1.0) > _RATE_TOLERANCE:
        messages.append(
            f"{path} has {speed:.3g} frames per second, but the agent makes "
            f"{wanted:.3g} steps: about {speed / wanted:.3g} frames per step. "
            "Adjust demonstrations.frame_skip or action_repeat."
        )
    messages += [f"{path}: {note}" for note in metadata["notes"]]
    for message in messages:
        _logger.warning("%s", printable(message))


def warn_of_versions(path: pathlib.Path, recorded: dict[str, str]) -> None:
    """Warns if a file of states was recorded with other simulator versions."""
    differing = [
        f"{name} {recorded.get(name)} (here {version})"
        for name, version in suite.simulator_versions().items()
        if recorded.get(name) != version
    ]
    if differing:
        _logger.warning(
            "%s was recorded with %s: motion and appearance may differ slightly.",
            printable(path),
            printable(", ".join(differing)),
        )
