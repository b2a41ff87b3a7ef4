"""Loads demonstrations of any format as the agent observes them."""

import functools
import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxil.demonstrations import foreign, mismatch, rendering, states
from jaxil.demonstrations.readers.recording import FormatError, Recording
from jaxil.demonstrations.states import StateDemonstrations, fault, unreadable
from jaxil.demonstrations.types import Demonstrations, Wanted, returns_of
from jaxil.environments import suite, tasks

_WAY_OUT = "`jaxil collect --inspect=FILE` shows what a file holds"


def check(
    source: str | os.PathLike, *, sees_actions: bool = False, **wanted: Any
) -> None:
    """Raises what `load` would raise, without rendering anything.

    `sees_actions` says whether the method needs the expert's actions; for the other
    arguments see `load`.
    """
    path, request = _found(source, wanted)
    if states.recognises(path):
        _open_states(path, request)
        return
    loaded = _load_pixels(path, request)
    if not sees_actions:
        return
    if loaded.actions is None:
        raise fault(path, "holds no actions", "Use a method that needs none")
    task, needed = request.task, _model_sizes(request.task)["actions"]
    if loaded.actions.shape[2] != needed:
        what = f"has actions of {loaded.actions.shape[2]} numbers"
        way_out = "Use a method that needs no actions"
        raise fault(path, f"{what}, but {task} needs {needed}", way_out)


def mean_return(source: str | os.PathLike = "", **wanted: Any) -> float | None:
    """Returns the mean task return without rendering; None if unknown. See `load`."""
    path, request = _found(source, wanted)
    if states.recognises(path):
        return float(np.mean(returns_of(_rewards(*_open_states(path, request)))))
    return _load_pixels(path, request).mean_return()


def load(
    source: str | os.PathLike = "",
    *,
    render_quality: str = "paper",
    camera: str = "",
    distraction: str = "none",
    cache: bool = True,
    warns: bool = True,
    progress: Callable[[int, int], None] | None = None,
    **wanted: Any,
) -> Demonstrations:
    """Loads demonstrations; states are rendered by the agent's own environment.

    Arguments not listed are those of `tasks.make_environment`.

    Args:
      source: a file or folder of any format in `foreign.FORMATS`; "" for the task's
        shipped states.
      cache: whether to cache rendered images.
      warns: whether to warn of what differs from the agent's observations.
      progress: called with (images done, all images) while rendering.
      wanted: the fields of `Wanted`; `task` is required.

    Raises:
      DemonstrationError: the file cannot be read, is damaged, or does not fit.
    """
    path, request = _found(source, wanted)
    if not states.recognises(path):
        loaded = _load_pixels(path, request)
        if warns:
            mismatch.warn_of_pixels(path, loaded, request)
            mismatch.warn_of_expert(path, loaded, request)
        return loaded
    stored, stride = _open_states(path, request)
    metadata = stored.metadata
    if warns:
        mismatch.warn_of_versions(path, metadata["versions"])
    rewards = _rewards(stored, stride)
    used = rewards.shape[1] * stride
    try:
        frames = rendering.observe_episodes(
            stored.simulator_states(slice(0, used + 1, stride)),
            task=request.task,
            seed=metadata["seed"],
            first_episode=metadata["first_episode"],
            image_size=request.image_size,
            render_quality=render_quality,
            observation=request.observation,
            camera=camera,
            distraction=distraction,
            cache=cache,
            progress=progress,
        )
    except ValueError as error:
        raise fault(path, f"cannot be rendered ({error})") from error
    num_frames = np.full(len(rewards), rewards.shape[1] + 1)
    actions = stored.actions[:, :used:stride]
    served = {"file": str(path), "action_repeat": request.action_repeat}
    metadata = {**metadata, **served, "returns": returns_of(rewards)}
    loaded = Demonstrations(frames, num_frames, actions, rewards, metadata)
    if warns:
        mismatch.warn_of_expert(path, loaded, request)
    return loaded


def _found(
    source: str | os.PathLike, wanted: dict[str, Any]
) -> tuple[pathlib.Path, Wanted]:
    """Returns the file, and the request; without `num_episodes`, fewer will do."""
    request = Wanted(**{"takes_fewer": "num_episodes" not in wanted, **wanted})
    if not str(source):
        return states.shipped_path(request.task), request
    return pathlib.Path(os.path.expanduser(source)), request


def _rewards(stored: StateDemonstrations, stride: int) -> np.ndarray:
    """Returns the rewards of whole agent steps, each of `stride` stored ones."""
    count, length = stored.rewards.shape
    whole = stored.rewards[:, : length // stride * stride]
    return whole.reshape(count, -1, stride).sum(2)


def _open_states(
    path: pathlib.Path, request: Wanted
) -> tuple[StateDemonstrations, int]:
    """Returns a file's content, and the stored steps per agent step."""
    task, action_repeat = request.task, request.action_repeat
    stored = states.read_states(
        path,
        task=task,
        num_episodes=request.num_episodes,
        takes_fewer=request.takes_fewer,
    )
    recorded = stored.metadata["action_repeat"]
    if action_repeat < 1 or action_repeat % recorded:
        what = f"was recorded with action_repeat={recorded}, not {action_repeat}"
        raise fault(path, what, f"Use a multiple of {recorded}, or record it again")
    if request.frame_skip != 1:
        what = f"holds states, but frame_skip={request.frame_skip} is for pixels"
        raise fault(path, what, "Set demonstrations.frame_skip to 1")
    stride = action_repeat // recorded
    if stride > stored.rewards.shape[1]:
        what = f"has episodes shorter than one step of action_repeat={action_repeat}"
        raise fault(path, what, "Choose a smaller action_repeat")
    if request.observation == "pixels":
        side, (num_episodes, num_steps) = request.image_size, stored.rewards.shape
        num_bytes = num_episodes * (num_steps // stride + 1) * side**2 * 3
        if num_bytes > request.max_bytes:
            what = f"needs {num_bytes} bytes at {side}x{side} pixels, more than the "
            way_out = "Use fewer episodes, or a smaller image_size"
            raise fault(path, f"{what}{request.max_bytes} allowed", way_out)
    sizes = _model_sizes(task)
    if len(sizes) == 1:
        what = f"holds simulator states, which {task} cannot take"
        raise fault(path, what, "Use a file of pixels")
    for name, size in sizes.items():
        found = getattr(stored, name).shape[2]
        if found != size:
            raise fault(path, f"has {name} of {found} numbers, but {task} needs {size}")
    return stored, stride


def _load_pixels(path: pathlib.Path, request: Wanted) -> Demonstrations:
    """Reads a file of pixels, or returns it again if it was the last one read."""
    try:
        parts = sorted(path.rglob("*")) if path.is_dir() else [path]
        stamps = tuple((str(part), part.stat().st_mtime_ns) for part in parts)
    except OSError as error:
        raise unreadable(path, error) from error
    return _read_pixels(path, stamps, request)


# `check` and `load` share one read. The run keeps these pixels in memory anyway.
@functools.lru_cache(maxsize=1)
def _read_pixels(
    path: pathlib.Path, stamps: tuple[tuple[str, int], ...], request: Wanted
) -> Demonstrations:
    del stamps  # part of the key only
    task, num_episodes, skip = request.task, request.num_episodes, request.frame_skip
    if request.observation != "pixels":
        what = f"holds pixels or is damaged, but observation={request.observation!r}"
        raise fault(path, what, "Set observation to 'pixels', or use a file of states")
    if num_episodes < 1 or skip < 1:
        what = f"does not fit num_episodes={num_episodes} and frame_skip={skip}"
        raise fault(path, what, "Both must be at least 1")
    by_time = request.sampling == "time"
    if by_time and skip > 1:
        what = f"is sampled by time, but demonstrations.frame_skip={skip}"
        raise fault(path, what, "Set one of the two")

    def frames_per_step(recording: Recording) -> float:
        if recording.action_repeat:
            return request.action_repeat / recording.action_repeat
        seconds, _ = tasks.timing(task, request.action_repeat)
        if not recording.frames_per_second or not seconds:
            raise FormatError(
                "has no frame rate, so it cannot be sampled by time; set "
                "demonstrations.action_repeat"
            )
        return recording.frames_per_second * seconds

    try:
        loaded = foreign.read_episodes(
            path, request, frames_per_step if by_time else None
        )
    except OSError as error:
        raise unreadable(path, error) from error
    except FormatError as error:
        raise fault(path, str(error), _WAY_OUT) from error
    shown = loaded.metadata["task"]
    if shown not in (None, task):
        raise states.other_task(path, shown, task)
    return loaded


@functools.cache
def _model_sizes(task: str) -> dict[str, int]:
    """Returns the lengths of an action, and of qpos, qvel and act if there are any."""
    with tasks.make_environment(task, seed=0) as environment:
        sizes = {"actions": environment.action_spec().shape[0]}
        if isinstance(environment, suite.SuiteEnvironment):
            states = environment.simulator_state()
            sizes |= {name: len(array) for name, array in states.items()}
        return sizes
