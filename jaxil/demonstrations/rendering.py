"""Images of stored simulator states, drawn once per machine and then cached."""

import hashlib
import json
import logging
import os
import pathlib
import tempfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxil.demonstrations import drawing
from jaxil.demonstrations.drawer import Episode
from jaxil.environments import suite
from jaxil.machine.cache import cache_folder

# Part of each key: raise it when drawing changes in a way that the key can't see.
_CACHE_VERSION = 2

_logger = logging.getLogger(__name__)


def observe_episodes(
    states: Mapping[str, np.ndarray],
    *,
    task: str,
    seed: int,
    first_episode: int,
    image_size: int,
    render_quality: str,
    observation: str = "pixels",
    cache: bool = True,
    progress: Callable[[int, int], None] | None = None,
    processes: int | None = None,
) -> np.ndarray:
    """Shows stored episodes as the agent's own environment would.

    Args:
      states: `qpos`, `qvel` and `act`, each of shape [K, N + 1, n].
      task: `domain_task`.
      seed: of the environment that recorded them.
      first_episode: number of episode 0 there. With the seed it restores what the
        states don't hold: targets, terrain.
      image_size: height and width in pixels.
      render_quality: "paper", "fast" or "smooth".
      observation: "pixels" or "state".
      cache: whether images are looked up in, and added to, `cache_folder()`.
      progress: called with (images drawn, images in all), if any have to be.
      processes: how many draw, see `drawing.draw`; the images are the same.

    Returns:
      Images, uint8 [K, N + 1, H, W, 3], or states, float32 [K, N + 1, S].

    Raises:
      ValueError: the states don't fit the task's model, or see `make_environment`.
      RuntimeError: nothing here can render.
    """
    settings = {
        "task": task,
        "seed": seed,
        "image_size": image_size,
        "frame_stack": 1,
        "render_quality": render_quality,
        "observation": observation,
    }
    environment = suite.make_environment(**settings)
    try:
        spec = environment.observation_spec()
        num_episodes, length = states["qpos"].shape[:2]
        observed = np.empty((num_episodes, length, *spec.shape), spec.dtype)
        caches = cache and observation == "pixels"
        about = {
            "task": task,
            "seed": seed,
            "image_size": image_size,
            "render_quality": render_quality,
            "camera": suite.camera_of(task),
            "versions": suite.simulator_versions(),
            "gl": environment.renderer.gl_name() if caches else "",
        }
        episodes = [
            Episode(
                place,
                first_episode + place,
                {name: array[place] for name, array in states.items()},
            )
            for place in range(num_episodes)
        ]
        paths = [
            _cache_path({**about, "episode": episode.number}, episode.states)
            for episode in episodes
        ]
        missing = []
        for episode, path in zip(episodes, paths):
            found = _read_cached(path, observed[episode.place]) if caches else None
            if found is None:
                missing.append(episode)
            else:
                observed[episode.place] = found
        num_drawn = (num_episodes - len(missing)) * length

        def take(place: int, start: int, images: np.ndarray) -> None:
            nonlocal num_drawn
            end = start + len(images)
            observed[place, start:end] = images
            for _ in images:
                num_drawn += 1
                if progress is not None:
                    progress(num_drawn, num_episodes * length)
            if caches and end == length:
                _write_cached(paths[place], observed[place])

        drawing.draw(
            environment,
            missing,
            settings=settings,
            take=take,
            processes=processes if observation == "pixels" else 1,
        )
    finally:
        environment.close()
    return observed


def _cache_path(
    about: dict[str, Any], states: Mapping[str, np.ndarray]
) -> pathlib.Path:
    """Returns a file whose name changes with all that changes an episode's pixels."""
    about = {**about, "cache_version": _CACHE_VERSION}
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name, array in sorted(states.items()):
        digest.update(f"{name}{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    name = f"{about['task']}-{digest.hexdigest()[:24]}.npy"
    return cache_folder() / "frames" / name


def _read_cached(path: pathlib.Path, like: np.ndarray) -> np.ndarray | None:
    """Returns the array at `path`; None unless it is whole and shaped `like`."""
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    if getattr(array, "shape", None) != like.shape or array.dtype != like.dtype:
        return None
    return array


def _write_cached(path: pathlib.Path, array: np.ndarray) -> None:
    """Stores `array` whole or not at all; where that fails, says so and goes on.

    Several processes may store the same: each renames a file of its own over it.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
        temporary = pathlib.Path(name)
        with os.fdopen(handle, "wb") as file:
            np.save(file, array, allow_pickle=False)
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        _logger.warning(
            "images are not cached, so the next run draws them again: %s. "
            "JAXIL_CACHE=DIR names another folder.",
            error,
        )
