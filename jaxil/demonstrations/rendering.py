"""Renders stored simulator states, in parallel, and caches the images."""

import concurrent.futures
import contextlib
import functools
import hashlib
import json
import logging
import multiprocessing
import os
import pathlib
import sys
import threading
import types
from collections.abc import Callable, Generator, Iterator, Mapping
from typing import Any

import numpy as np

from jaxil.environments import suite, tasks
from jaxil.environments.camera import renders_in_software
from jaxil.environments.pool import interrupts_blocked
from jaxil.files import archive
from jaxil.machine.cache import cache_folder

# Part of each key; increment it when images change for a reason not in the key.
_CACHE_VERSION = 2
_MAX_PROCESSES = 8  # each takes about 250 MB
# Takes seconds in software. Fewer pixels are rendered before a process has started.
_MIN_PARALLEL_PIXELS = 2_000_000
_TIMEOUT_SECONDS = 1800.0  # for the next episode of any process

States = dict[str, np.ndarray]  # `qpos`, `qvel` and `act` of one episode, [N + 1, n]

_logger = logging.getLogger(__name__)


def observe_episodes(
    states: Mapping[str, np.ndarray],
    *,
    task: str,
    seed: int,
    first_episode: int,
    image_size: int,
    render_quality: str,
    cache: bool = True,
    progress: Callable[[int, int], None] | None = None,
    processes: int | None = None,
    **settings: Any,
) -> np.ndarray:
    """Observes stored episodes with the agent's own environment.

    Arguments and errors not listed are those of `tasks.make_environment`.

    Args:
      states: `qpos`, `qvel` and `act`, each of shape [K, N + 1, n].
      seed: of the recording environment.
      first_episode: its number there. The two restore what is not in the states:
        targets, terrain.
      cache: whether to read and write images in `cache_folder()`.
      progress: called with (images done, all images) while rendering.
      processes: None chooses the number. The images do not depend on it.
      settings: `observation`, `camera` and `distraction`, if they are not the usual.

    Returns:
      Images, uint8 [K, N + 1, H, W, 3], or states, float32 [K, N + 1, S].

    Raises:
      ValueError: the task has no simulator states, or these do not fit its model.
      RuntimeError: rendering is not available.
    """
    settings |= {
        "task": task,
        "seed": seed,
        "image_size": image_size,
        "frame_stack": 1,
        "render_quality": render_quality,
    }
    is_rendered = settings.get("observation", "pixels") == "pixels"
    with tasks.make_environment(**settings) as environment:
        if not isinstance(environment, suite.SuiteEnvironment):
            raise ValueError(f"holds simulator states, which {task} cannot take")
        num_episodes, length = states["qpos"].shape[:2]
        spec = environment.observation_spec()
        observed = np.empty((num_episodes, length, *spec.shape), spec.dtype)
        numbers = range(first_episode, first_episode + num_episodes)
        images = dict(zip(numbers, observed, strict=True))  # views, by episode
        missing = {
            number: {name: array[index] for name, array in states.items()}
            for index, number in enumerate(numbers)
        }
        paths: dict[int, pathlib.Path] = {}
        if cache and is_rendered:
            paths = _cache_paths(environment, settings, missing)
            for number, path in paths.items():
                if _read_cached(path, images[number]):
                    del missing[number]
        num_rendered = (num_episodes - len(missing)) * length

        def show(num_images: int) -> None:
            nonlocal num_rendered
            num_rendered += num_images
            if progress is not None:
                progress(num_rendered, num_episodes * length)

        def finish(number: int) -> None:
            del missing[number]
            if paths:
                _write_cached(paths[number], images[number])

        if not is_rendered:
            processes = 1
        elif processes is None:
            num_pixels = len(missing) * length * environment.image_size**2
            processes = num_processes(num_pixels, environment.renderer.gl_name())
        if processes > 1 and len(missing) > 1:
            rendered = _render_together(
                min(processes, len(missing)),
                dict(missing),
                settings,
                environment.renderer.gl_name(),
            )
            with contextlib.closing(rendered):
                for number, found in rendered:
                    images[number][:] = found
                    finish(number)
                    show(length)
        for number, each in list(missing.items()):
            for time, image in enumerate(_observations(environment, number, each)):
                images[number][time] = image
                show(1)
            finish(number)
    return observed


def num_processes(num_pixels: int, gl_name: str) -> int:
    """Returns how many processes render so many pixels in the shortest time."""
    # One process is fast enough on a GPU, where parallel EGL contexts may hang.
    if not renders_in_software(gl_name) or num_pixels < _MIN_PARALLEL_PIXELS:
        return 1
    return min(len(os.sched_getaffinity(0)), _MAX_PROCESSES)


def _observations(
    environment: suite.SuiteEnvironment, number: int, states: States
) -> Iterator[np.ndarray]:
    """Yields the frames of an episode, uint8 [H, W, 3], or its state vectors [S]."""
    environment.reset(episode=number)  # restores what is not in the states
    for values in zip(*states.values(), strict=True):
        environment.set_simulator_state(**dict(zip(states, values, strict=True)))
        yield environment.single_observation()


def _render_together(
    processes: int, episodes: dict[int, States], settings: dict[str, Any], gl_name: str
) -> Generator[tuple[int, np.ndarray], None, None]:
    """Yields episode numbers and images in any order, until an episode fails.

    Software renderers use one core for small images, so the speed grows with the number
    of processes. Closing the generator ends them.
    """
    executor = concurrent.futures.ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_end_with_parent,
    )
    others = set(multiprocessing.active_children())
    try:
        with interrupts_blocked(), _main_hidden():
            numbers = {
                executor.submit(_render_episode, settings, gl_name, *item): item[0]
                for item in episodes.items()
            }
        pending = set(numbers)
        while pending:
            done, pending = concurrent.futures.wait(
                pending, _TIMEOUT_SECONDS, concurrent.futures.FIRST_COMPLETED
            )
            if not done:
                raise TimeoutError(f"no episode in {_TIMEOUT_SECONDS:g} s")
            for future in done:
                yield numbers[future], future.result()
    except Exception as error:
        _logger.warning(
            "parallel rendering failed (%s); continuing in one process",
            str(error) or type(error).__name__,
        )
    finally:
        # Killed, because cleanup in GL drivers may hang.
        for process in set(multiprocessing.active_children()) - others:
            process.kill()
        # A process killed while it sends images leaves half of them in the pipe. The
        # executor waits for the rest until the last writing end is closed: this one.
        executor._result_queue._writer.close()  # pyright: ignore[reportAttributeAccessIssue]
        executor.shutdown()


@contextlib.contextmanager
def _main_hidden() -> Iterator[None]:
    """Keeps spawned processes from importing, and so running, the caller's script."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _end_with_parent() -> None:
    """Ends a process of the executor when its parent is killed."""
    os.environ.setdefault("LP_NUM_THREADS", "0")  # one llvmpipe thread per process
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _render_episode(
    settings: dict[str, Any], gl_name: str, number: int, states: States
) -> np.ndarray:
    """Renders an episode in another process: [N + 1, H, W, 3]."""
    environment = _own_environment(**settings)
    assert isinstance(environment, suite.SuiteEnvironment)
    found = environment.renderer.gl_name()
    if found != gl_name:
        raise RuntimeError(f"rendered with {found}, not with {gl_name}")
    return np.stack(list(_observations(environment, number, states)))


_own_environment = functools.cache(tasks.make_environment)


def _cache_paths(
    environment: suite.SuiteEnvironment,
    settings: dict[str, Any],
    episodes: dict[int, States],
) -> dict[int, pathlib.Path]:
    """Returns each episode's cache file; its name is a hash of all inputs."""
    task, names = settings["task"], ("task", "seed", "image_size", "render_quality")
    about = {
        **{name: settings[name] for name in names},
        "camera": settings.get("camera") or suite.camera_of(task),
        "versions": suite.simulator_versions(),
        "gl": environment.renderer.gl_name(),
        "cache_version": _CACHE_VERSION,
    }
    if settings.get("distraction", "none") != "none":
        about["distraction"] = settings["distraction"]
    if tasks.names_code(task):  # which may have changed
        about["model"] = environment.model_digest()
    paths = {}
    for number, states in episodes.items():
        key = json.dumps({**about, "episode": number}, sort_keys=True)
        digest = hashlib.sha256(key.encode())
        for name, array in sorted(states.items()):
            digest.update(f"{name}{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        name = f"{task}-{digest.hexdigest()[:24]}.npz"
        paths[number] = cache_folder() / "frames" / name
    return paths


def _read_cached(path: pathlib.Path, images: np.ndarray) -> bool:
    """Fills `images` from a cached file; returns whether that is whole and fits."""
    try:
        limits = {"images": images.nbytes + 1000}
        found = archive.read_archive(path, max_bytes=limits)["images"]
    except (OSError, ValueError):
        return False
    if found.shape != images.shape or found.dtype != images.dtype:
        return False
    images[:] = found
    return True


def _write_cached(path: pathlib.Path, images: np.ndarray) -> None:
    """Stores images, or warns."""
    try:
        archive.write_archive(path, [("images", images)], level=0)
    except OSError as error:
        _logger.warning(
            "images are not cached and will be rendered again: %s. Set "
            "JAXIL_CACHE=DIR to use another folder.",
            error,
        )
