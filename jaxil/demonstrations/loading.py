"""Demonstrations as the agent would see them, from files of any format."""

import functools
import os
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxil.demonstrations import foreign, mismatch, rendering, states
from jaxil.demonstrations.readers.recording import FormatError
from jaxil.demonstrations.states import StateDemonstrations, fault, unreadable
from jaxil.environments import suite
from jaxil.maths.types import ExpertBatch
from jaxil.replay.stacking import gather_stacks

_WAY_OUT = (
    "Repair or replace it; `python -m jaxil.collect --inspect=FILE` shows what a file "
    "holds"
)


class Demonstrations(NamedTuple):
    """Expert episodes as the agent would see them.

    Attributes:
      frames: single images, uint8 [K, N + 1, H, W, 3], or, where the agent observes
        states, float32 [K, N + 1, S]. A shorter episode repeats its last frame.
      num_frames: how many of them are the episode's own. Shape [K].
      actions: float32 [K, N, A]; None where the file has none. Only for methods that
        may see them.
      task_rewards: float32 [K, N]; None where the file has none. Only for logs.
      metadata: the file's, with `file`, `action_repeat`, and `returns` as served: one
        number for each episode, or none at all.
    """

    frames: np.ndarray
    num_frames: np.ndarray
    actions: np.ndarray | None
    task_rewards: np.ndarray | None
    metadata: dict[str, Any]

    def mean_return(self) -> float | None:
        """Returns the mean task return; None where rewards are not known."""
        returns = self.metadata["returns"]
        return float(np.mean(returns)) if returns else None


def check(
    source: str | os.PathLike,
    *,
    task: str,
    num_episodes: int,
    action_repeat: int,
    image_size: int = 84,
    observation: str = "pixels",
    frame_skip: int = 1,
    max_bytes: int = states.MAX_ARRAY_BYTES,
    sees_actions: bool = False,
) -> None:
    """Finds out whether `load` would succeed, without rendering anything.

    Args:
      source: see `load`, as all others.
      sees_actions: whether the method needs the expert's actions.

    Raises:
      DemonstrationError: as `load`.
    """
    path = _path_of(source, task)
    if states.recognises(path):
        _open_states(path, task, num_episodes, action_repeat, frame_skip)
        return
    loaded = _load_pixels(
        path, task, num_episodes, image_size, observation, frame_skip, max_bytes
    )
    if not sees_actions:
        return
    if loaded.actions is None:
        raise fault(
            path, "holds no actions, which this method sees", "Choose another method"
        )
    needed = _model_sizes(task)["actions"]
    if loaded.actions.shape[2] != needed:
        raise fault(
            path,
            f"has actions of {loaded.actions.shape[2]} numbers, where {task} needs "
            f"{needed}",
            "Choose a method that sees no actions",
        )


def load(
    source: str | os.PathLike,
    *,
    task: str,
    num_episodes: int,
    action_repeat: int,
    image_size: int,
    render_quality: str,
    observation: str = "pixels",
    frame_skip: int = 1,
    max_bytes: int = states.MAX_ARRAY_BYTES,
    cache: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Demonstrations:
    """Loads demonstrations; states are rendered by the agent's own environment.

    Args:
      source: a file or folder of any format in `foreign.FORMATS`; "" for the states
        that are shipped for the task.
      task: `domain_task`.
      num_episodes: how many, the file's first ones.
      action_repeat: the agent's; a multiple of a state file's. Where several stored
        steps become one, their rewards are summed and the first action is kept.
      image_size: height and width in pixels.
      render_quality: "paper", "fast" or "smooth".
      observation: "pixels" or "state".
      frame_skip: for files of pixels: every so many-th frame is kept.
      max_bytes: for files of pixels: the memory that they may take.
      cache: whether to keep rendered images, in `machine.cache.cache_folder()`.
      progress: called with (images rendered, images in all) if any have to be.

    Raises:
      DemonstrationError: the file cannot be read, is not one of demonstrations, is
        damaged, or is not what was asked for.
    """
    path = _path_of(source, task)
    if not states.recognises(path):
        loaded = _load_pixels(
            path, task, num_episodes, image_size, observation, frame_skip, max_bytes
        )
        mismatch.warn_of_pixels(
            path,
            loaded.metadata,
            image_size=image_size,
            task=task,
            action_repeat=action_repeat,
        )
        return loaded
    stored, stride = _open_states(path, task, num_episodes, action_repeat, frame_skip)
    metadata = stored.metadata
    mismatch.warn_of_versions(path, metadata["versions"])
    num_steps = stored.rewards.shape[1] // stride
    used = num_steps * stride
    try:
        frames = rendering.observe_episodes(
            stored.simulator_states(slice(0, used + 1, stride)),
            task=task,
            seed=metadata["seed"],
            first_episode=metadata["first_episode"],
            image_size=image_size,
            render_quality=render_quality,
            observation=observation,
            cache=cache,
            progress=progress,
        )
    except ValueError as error:
        raise fault(path, f"cannot be shown ({error})") from error
    rewards = stored.rewards[:, :used].reshape(num_episodes, num_steps, stride).sum(2)
    served = {"file": str(path), "action_repeat": action_repeat}
    return Demonstrations(
        frames,
        np.full(num_episodes, num_steps + 1),
        stored.actions[:, :used:stride],
        rewards,
        {**metadata, **served, "returns": _returns(rewards)},
    )


def sample(
    demonstrations: Demonstrations,
    rng: np.random.Generator,
    batch_size: int,
    *,
    frame_stack: int,
    successors: bool = False,
) -> ExpertBatch:
    """Samples expert observations with the actions taken there, uniformly.

    Args:
      demonstrations: whole episodes of single frames.
      rng: source of the draw.
      batch_size: B.
      frame_stack: frames in an observation; an episode's first frame stands in for
        those before it.
      successors: whether to add the observations one step later.

    Returns:
      Observations uint8 [B, H, W, 3 * frame_stack] or float32 [B, S], and actions
      [B, A]; A is 0 where the demonstrations have none.
    """
    found = sample_indices(
        demonstrations,
        rng,
        batch_size,
        frame_stack=frame_stack,
        successors=successors,
    )
    # As one long row of frames, without a copy, from which stacks are gathered.
    frames = demonstrations.frames.reshape(-1, *demonstrations.frames.shape[2:])
    successor = found.successor
    return found._replace(
        observation=gather_stacks(frames, found.observation),
        successor=None if successor is None else gather_stacks(frames, successor),
    )


def sample_indices(
    demonstrations: Demonstrations,
    rng: np.random.Generator,
    batch_size: int,
    *,
    frame_stack: int,
    successors: bool = False,
) -> ExpertBatch:
    """Samples what `sample` does, with the indices of frames instead of pixels.

    Returns:
      Observations int32 [B, frame_stack]: indices, the oldest first, into the frames of
      all episodes laid end to end, [K * (N + 1), ...].
    """
    num_steps = demonstrations.num_frames - 1  # no action follows the last frame
    ends = np.cumsum(num_steps)
    chosen = rng.integers(ends[-1], size=batch_size)
    episodes = np.searchsorted(ends, chosen, side="right")
    steps = chosen - (ends - num_steps)[episodes]

    def stacks(times: np.ndarray) -> np.ndarray:
        ages = np.arange(frame_stack - 1, -1, -1)
        inside = np.maximum(times[:, None] - ages, 0)
        first = episodes[:, None] * demonstrations.frames.shape[1]
        return (first + inside).astype(np.int32)

    actions = (
        np.zeros((batch_size, 0), np.float32)
        if demonstrations.actions is None
        else demonstrations.actions[episodes, steps]
    )
    successor = stacks(steps + 1) if successors else None
    return ExpertBatch(stacks(steps), actions, successor)


def _path_of(source: str | os.PathLike, task: str) -> pathlib.Path:
    return pathlib.Path(source) if str(source) else states.shipped_path(task)


def _returns(task_rewards: np.ndarray | None) -> list[float]:
    if task_rewards is None:
        return []
    return task_rewards.astype(np.float64).sum(axis=1).tolist()


def _open_states(
    path: pathlib.Path,
    task: str,
    num_episodes: int,
    action_repeat: int,
    frame_skip: int,
) -> tuple[StateDemonstrations, int]:
    """Returns a file's contents, and how many stored steps make one of the agent's."""
    stored = states.read_states(path, task=task, num_episodes=num_episodes)
    recorded = stored.metadata["action_repeat"]
    if action_repeat < 1 or action_repeat % recorded:
        raise fault(
            path,
            f"was recorded with action_repeat={recorded}, which cannot serve "
            f"action_repeat={action_repeat}",
            f"Take a multiple of {recorded}, or record it again",
        )
    if frame_skip != 1:
        raise fault(
            path,
            f"holds states, which follow action_repeat, and frame_skip={frame_skip} "
            "is for pixels",
            "Set demonstrations.frame_skip to 1",
        )
    stride = action_repeat // recorded
    if stride > stored.rewards.shape[1]:
        raise fault(
            path,
            f"has episodes shorter than one step of action_repeat={action_repeat}",
            "Choose a smaller action_repeat",
        )
    for name, size in _model_sizes(task).items():
        found = getattr(stored, name).shape[2]
        if found != size:
            raise fault(
                path, f"has {name} of {found} numbers, where {task} needs {size}"
            )
    return stored, stride


def _load_pixels(path: pathlib.Path, *request: Any) -> Demonstrations:
    """Reads a foreign file, or returns it again if it was the last one read."""
    try:
        parts = sorted(path.rglob("*")) if path.is_dir() else [path]
        stamps = tuple((str(part), part.stat().st_mtime_ns) for part in parts)
    except OSError as error:
        raise unreadable(path, error) from error
    return _read_pixels(path, stamps, *request)


# Checked at the door and loaded afterwards: both are one reading. The pixels that this
# keeps are those that the run keeps anyhow.
@functools.lru_cache(maxsize=1)
def _read_pixels(
    path: pathlib.Path,
    stamps: tuple[tuple[str, int], ...],
    task: str,
    num_episodes: int,
    image_size: int,
    observation: str,
    frame_skip: int,
    max_bytes: int,
) -> Demonstrations:
    del stamps  # part of the key only
    if observation != "pixels":
        raise fault(
            path,
            f"holds pixels or is damaged, and cannot serve observation={observation!r}",
            "Set observation to 'pixels', or name a file of states",
        )
    if num_episodes < 1 or frame_skip < 1:
        raise fault(
            path,
            f"cannot serve num_episodes={num_episodes} with frame_skip={frame_skip}",
            "Both are at least 1",
        )
    try:
        read = foreign.read_episodes(
            path,
            num_episodes=num_episodes,
            image_size=image_size,
            frame_skip=frame_skip,
            max_bytes=max_bytes,
        )
    except OSError as error:
        raise unreadable(path, error) from error
    except FormatError as error:
        raise fault(path, str(error), _WAY_OUT) from error
    recording = read.recording
    if recording.task not in (None, task):
        raise states.other_task(path, recording.task, task)
    metadata = {
        "task": recording.task,
        "file": str(path),
        "kind": recording.kind,
        "action_repeat": recording.action_repeat,
        "frames_per_second": recording.frames_per_second,
        "stored_size": read.stored_size,
        "notes": recording.notes,
        "returns": _returns(read.rewards),
    }
    return Demonstrations(
        read.frames, read.num_frames, read.actions, read.rewards, metadata
    )


@functools.cache
def _model_sizes(task: str) -> dict[str, int]:
    """Returns the lengths of qpos, qvel, act and an action."""
    with suite.make_environment(task, seed=0, observation="state") as environment:
        sizes = {name: len(x) for name, x in environment.simulator_state().items()}
        return {**sizes, "actions": environment.action_spec().shape[0]}
