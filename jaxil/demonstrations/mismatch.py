"""Warnings: how demonstrations differ from what the agent itself sees."""

import logging
import pathlib
from typing import Any

from jaxil.environments import suite

# A video's frame rate may be off by this share before anyone is told.
_RATE_TOLERANCE = 0.1

_logger = logging.getLogger(__name__)


def warn_of_pixels(
    path: pathlib.Path,
    metadata: dict[str, Any],
    *,
    image_size: int,
    task: str,
    action_repeat: int,
) -> None:
    """Warns where a foreign file cannot match the agent's view.

    Args:
      path: the file.
      metadata: of `Demonstrations` that were read from pixels.
      image_size: the agent's, as are task and action repeat.
      task: `domain_task`.
      action_repeat: environment frames per agent step.
    """
    size, (height, width) = image_size, metadata["stored_size"]
    messages = [
        f"{path} ({metadata['kind']}) holds pixels of another renderer: light, colour "
        "and camera may differ from what the agent sees."
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
            f"{path} was recorded with action_repeat={repeat}, and the run has "
            f"{action_repeat}: set action_repeat or demonstrations.frame_skip so that "
            "they agree."
        )
    speed = metadata["frames_per_second"]
    wanted = 1.0 / suite.decision_seconds(task, action_repeat)
    if speed is not None and abs(speed / wanted - 1.0) > _RATE_TOLERANCE:
        messages.append(
            f"{path} has {speed:.3g} frames per second, and the agent makes "
            f"{wanted:.3g} steps: about {speed / wanted:.3g} frames make one step. "
            "Adjust demonstrations.frame_skip or action_repeat."
        )
    messages += [f"{path}: {note}" for note in metadata["notes"]]
    for message in messages:
        _logger.warning("%s", message)


def warn_of_versions(path: pathlib.Path, recorded: dict[str, str]) -> None:
    """Warns where simulator versions differ from those that recorded a state file."""
    differing = [
        f"{name} {recorded.get(name)} (here {version})"
        for name, version in suite.simulator_versions().items()
        if recorded.get(name) != version
    ]
    if differing:
        _logger.warning(
            "%s was recorded with %s: the task may move or look slightly different.",
            path,
            ", ".join(differing),
        )
