"""Warns where demonstrations differ from the agent's observations."""

import logging
import pathlib

import numpy as np

from jaxil.demonstrations.types import Demonstrations, Wanted
from jaxil.environments import suite, tasks
from jaxil.errors import printable

_RATE_TOLERANCE = 0.1  # relative, of a video's frame rate
_LARGEST_ACTION = 1.001  # 1, with room for rounding
_MAX_SHOWN = 10
_FITS = {  # of `demonstrations.fit`
    "stretch": "stretched to a square",
    "crop": "cut to the square in their middle",
    "pad": "with black bars",
}

_logger = logging.getLogger(__name__)


def warn_of_pixels(path: pathlib.Path, loaded: Demonstrations, wanted: Wanted) -> None:
    """Warns where a file of pixels differs from the agent's settings."""
    metadata, action_repeat = loaded.metadata, wanted.action_repeat
    size, (height, width) = wanted.image_size, metadata["stored_size"]
    messages = []
    if metadata["task"] != wanted.task or tasks.is_of_suite(wanted.task):
        messages.append(
            f"{path} ({metadata['kind']}) holds pixels of another renderer: light, "
            "colours and camera may differ from the agent's. See --config.camera."
        )
    if (height, width) != (size, size):
        fit = wanted.fit
        how = "" if height == width else f", {_FITS[fit]} (demonstrations.fit={fit})"
        messages.append(
            f"{path}: frames of {width}x{height} pixels are resized to {size}x{size}"
            f"{how}."
        )
    repeat = metadata["action_repeat"]
    if repeat is not None and repeat != action_repeat:
        messages.append(
            f"{path} was recorded with action_repeat={repeat}, but the run has "
            f"{action_repeat}: adjust action_repeat or demonstrations.frame_skip."
        )
    speed = metadata["frames_per_second"]
    seconds, episode_steps = tasks.timing(
        wanted.task, action_repeat, wanted.max_episode_frames
    )
    agents = 1.0 / seconds if seconds else speed
    if speed and agents and abs(speed / agents - 1.0) > _RATE_TOLERANCE:
        messages.append(
            f"{path} has {speed:.3g} frames per second, but the agent makes "
            f"{agents:.3g} steps: about {speed / agents:.3g} frames per step. "
            "Set demonstrations.sampling=time, or adjust demonstrations.frame_skip or "
            "action_repeat."
        )
    longest = int(loaded.num_frames.max()) - 1
    if not repeat and not speed and longest != episode_steps:
        messages.append(
            f"{path} does not say its action repeat, and its longest episode has "
            f"{longest} steps, but the agent's {episode_steps} at "
            f"action_repeat={action_repeat}. State demonstrations.action_repeat."
        )
    messages += [f"{path}: {note}" for note in metadata["notes"]]
    for message in messages:
        _logger.warning("%s", printable(message))


def warn_of_expert(path: pathlib.Path, loaded: Demonstrations, wanted: Wanted) -> None:
    """Warns of episodes from which nothing, or the wrong thing, can be learned."""
    frames, num_frames, actions, rewards, _ = loaded
    messages = []
    if len(frames) < wanted.num_episodes:
        messages.append(
            f"holds {len(frames)} of {wanted.num_episodes} episodes: all are used."
        )
    if actions is not None and np.abs(actions).max(initial=0.0) > _LARGEST_ACTION:
        messages.append(
            f"has actions from {actions.min():.3g} to {actions.max():.3g}, but the "
            "agent's lie in [-1, 1]: rescale them before actions are imitated."
        )
    still = [
        index
        for index, (episode, length) in enumerate(zip(frames, num_frames))
        if all(np.array_equal(episode[0], frame) for frame in episode[1:length])
    ]
    if still:
        shown = ", ".join(map(str, still[:_MAX_SHOWN]))
        messages.append(f"has episodes in which nothing ever changes: {shown}.")
    if rewards is not None and not rewards.any():
        messages.append("shows an expert whose task return is 0.")
    for message in messages:
        _logger.warning("%s", printable(f"{path} {message}"))


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
