"""Warnings: what of demonstrations can't match what the agent itself sees."""

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
    """Says what of a foreign file can't match the agent's own view.

    Args:
      path: the file.
      metadata: of `Demonstrations` that were read from pixels.
      image_size: the agent's, as are the next two.
      task: `domain_task`.
      action_repeat: environment frames per decision.
    """
    size = image_size
    height, width = metadata["stored_size"]
    _logger.warning(
        "%s (%s) holds pixels of a renderer that is not this one: what the agent sees "
        "may differ in light, colour and camera.",
        path,
        metadata["kind"],
    )
    if (height, width) != (size, size):
        squeezed = "" if height == width else ", squeezed into a square"
        _logger.warning(
            "%s: frames of %dx%d pixels are resized to %dx%d%s.",
            path,
            width,
            height,
            size,
            size,
            squeezed,
        )
    repeat = metadata["action_repeat"]
    if repeat is not None and repeat != action_repeat:
        _logger.warning(
            "%s was recorded with action_repeat=%d, and the run has %d: set "
            "action_repeat or demonstrations.frame_skip so that they agree.",
            path,
            repeat,
            action_repeat,
        )
    speed = metadata["frames_per_second"]
    wanted = 1.0 / suite.decision_seconds(task, action_repeat)
    if speed is not None and abs(speed / wanted - 1.0) > _RATE_TOLERANCE:
        _logger.warning(
            "%s has %.3g frames per second, and the agent decides %.3g times: set "
            "demonstrations.frame_skip, now such that about %.3g frames make one.",
            path,
            speed,
            wanted,
            speed / wanted,
        )
    for note in metadata["notes"]:
        _logger.warning("%s: %s", path, note)


def warn_of_versions(path: pathlib.Path, recorded: dict[str, str]) -> None:
    """Says which simulator versions differ from those that recorded a state file."""
    installed = suite.simulator_versions()
    differing = [
        f"{name} {recorded.get(name)} (here {version})"
        for name, version in installed.items()
        if recorded.get(name) != version
    ]
    if differing:
        _logger.warning(
            "%s was recorded with %s: its images are drawn here, but the task may move "
            "or look slightly different now.",
            path,
            ", ".join(differing),
        )
