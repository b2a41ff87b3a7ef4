"""The file format of demonstrations: simulator states, actions, rewards, metadata.

Such a file is a NumPy archive (.npz) of K episodes of T agent steps:

    qpos, qvel, act   float64 [K, T + 1, nq], [K, T + 1, nv], [K, T + 1, na]
    actions, rewards  float32 [K, T, A], [K, T]
    metadata          a JSON text, see `new_metadata`

Pixels are not stored: they would be a thousand times larger, and would not match the
renderer of another machine. Baselines alone may look at actions and rewards.
"""

import importlib.metadata
import json
import os
import pathlib
from typing import Any, NamedTuple

import numpy as np

from jaxil.environments import suite
from jaxil.files import archive

FORMAT = "jaxil-demonstrations"
VERSION = 1
MAX_ARRAY_BYTES = archive.MAX_BYTES
_MAX_METADATA_BYTES = 1024**2
_ARRAYS = {  # name: dtype, number of axes, states per episode beyond its steps
    "qpos": (np.dtype(np.float64), 3, 1),
    "qvel": (np.dtype(np.float64), 3, 1),
    "act": (np.dtype(np.float64), 3, 1),
    "actions": (np.dtype(np.float32), 3, 0),
    "rewards": (np.dtype(np.float32), 2, 0),
}
_METADATA = {
    "task": str,
    "action_repeat": int,
    "camera": int,
    "versions": dict,
    "seed": int,
    "first_episode": int,
    "expert": str,
    "returns": list,
}
_CHECK_PATH = "Check the path in demonstrations.source"
_REMAKE = "Record it again with `python -m jaxil.collect`, or name another file"


class DemonstrationError(ValueError):
    """Demonstrations cannot be used; says which file, why, and what helps."""


class StateDemonstrations(NamedTuple):
    """What a demonstration file holds.

    Attributes:
      qpos: positions, float64 [K, T + 1, nq].
      qvel: velocities, float64 [K, T + 1, nv].
      act: activations of the actuators, float64 [K, T + 1, na].
      actions: float32 [K, T, A], in [-1, 1].
      rewards: the task's, summed over the action repeat. float32 [K, T].
      metadata: see `new_metadata`.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    metadata: dict[str, Any]

    def simulator_states(
        self, times: np.ndarray | slice, episodes: slice = slice(None)
    ) -> dict[str, np.ndarray]:
        """Returns `qpos`, `qvel` and `act` of some episodes at some times."""
        named = {name: getattr(self, name) for name in ("qpos", "qvel", "act")}
        return {name: array[episodes, times] for name, array in named.items()}


def new_metadata(
    *,
    task: str,
    action_repeat: int,
    seed: int,
    first_episode: int,
    expert: str,
    rewards: np.ndarray,
) -> dict[str, Any]:
    """Returns the metadata of freshly recorded demonstrations.

    Args:
      task: `domain_task`.
      action_repeat: environment frames per stored step.
      seed: the recording environment's; with the episode's number it restores what
        a task samples at random beyond the state.
      first_episode: number of episode 0; the others follow it without a gap.
      expert: how the expert was made, for people.
      rewards: task rewards. Shape [K, T].
    """
    return {
        "format": FORMAT,
        "version": VERSION,
        "task": task,
        "action_repeat": action_repeat,
        "camera": suite.camera_of(task),
        "versions": {
            **suite.simulator_versions(),
            "jaxil": importlib.metadata.version("jaxil"),
        },
        "seed": seed,
        "first_episode": first_episode,
        "expert": expert,
        "returns": np.asarray(rewards, np.float64).sum(axis=1).tolist(),
    }


def shipped_tasks() -> tuple[str, ...]:
    """Returns the tasks whose demonstrations are part of the package, sorted."""
    return tuple(sorted(path.stem for path in _shipped_folder().glob("*.npz")))


def shipped_path(task: str) -> pathlib.Path:
    """Returns the package's own demonstrations of `task`.

    Raises:
      DemonstrationError: none are shipped for it.
    """
    path = _shipped_folder() / f"{task}.npz"
    if task not in shipped_tasks():
        raise DemonstrationError(
            f"no demonstrations of {task} are shipped, only of: "
            f"{', '.join(shipped_tasks()) or 'no task'}. Record some with "
            "`python -m jaxil.collect` and name the file in demonstrations.source."
        )
    return path


def write_states(path: str | os.PathLike, demonstrations: StateDemonstrations) -> None:
    """Writes a demonstration file, whole or not at all.

    Raises:
      DemonstrationError: the arrays or the metadata break the format's rules.
    """
    path = pathlib.Path(path)
    _check(path, demonstrations)
    arrays = {
        name: getattr(demonstrations, name).astype(dtype)
        for name, (dtype, _, _) in _ARRAYS.items()
    }
    arrays["metadata"] = np.array(json.dumps(demonstrations.metadata))
    archive.write_archive(path, arrays.items())


def recognises(path: pathlib.Path) -> bool:
    """Returns whether `path` is a file of this format, judged by its arrays' names.

    Raises:
      DemonstrationError: it is neither a file nor a folder, but a device or a pipe.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise fault(path, "is neither a file nor a folder", _CHECK_PATH)
    return "qpos" in archive.member_names(path)


def read_states(
    path: str | os.PathLike, *, task: str | None = None, num_episodes: int | None = None
) -> StateDemonstrations:
    """Reads a demonstration file and checks all of it; nothing is rendered.

    Args:
      path: the file.
      task: the task that it must be of; None takes any.
      num_episodes: how many episodes to return, the first ones; None for all.

    Raises:
      DemonstrationError: the file cannot be read, is not one of demonstrations,
        is damaged, or is not what was asked for.
    """
    path = pathlib.Path(path)
    limits = dict.fromkeys(_ARRAYS, archive.MAX_BYTES)
    limits["metadata"] = _MAX_METADATA_BYTES
    try:
        arrays = archive.read_archive(path, max_bytes=limits)
        metadata = json.loads(str(arrays.pop("metadata")))
    except OSError as error:
        raise unreadable(path, error) from error
    except (json.JSONDecodeError, RecursionError) as error:
        raise fault(path, f"has metadata that are not JSON ({error})") from error
    except ValueError as error:
        raise fault(path, str(error)) from error
    demonstrations = StateDemonstrations(**arrays, metadata=metadata)
    _check(path, demonstrations)
    if task is not None and metadata["task"] != task:
        raise other_task(path, metadata["task"], task)
    stored = len(demonstrations.rewards)
    if num_episodes is None:
        return demonstrations
    if not 1 <= num_episodes <= stored:
        raise fault(
            path,
            f"holds {stored} episodes, and num_episodes={num_episodes} were asked for",
            f"Ask for 1 to {stored}",
        )
    kept = [array[:num_episodes] for array in demonstrations[:-1]]
    metadata = {**metadata, "returns": metadata["returns"][:num_episodes]}
    return StateDemonstrations(*kept, metadata=metadata)


def _shipped_folder() -> pathlib.Path:
    return pathlib.Path(__file__).parent


def fault(path: pathlib.Path, what: str, way_out: str = _REMAKE) -> DemonstrationError:
    """Returns the error that says what is wrong with a file, and what helps."""
    return DemonstrationError(f"{path} {what}. {way_out}.")


def other_task(path: pathlib.Path, shown: str, task: str) -> DemonstrationError:
    """Returns what to raise where a file shows another task than the run's."""
    return fault(
        path, f"shows {shown}, but the task is {task}", "Set the one to the other's"
    )


def unreadable(path: pathlib.Path, error: OSError) -> DemonstrationError:
    """Returns what to raise where the system refuses a file."""
    return fault(path, f"cannot be read ({error.strerror or error})", _CHECK_PATH)


def _check(path: pathlib.Path, demonstrations: StateDemonstrations) -> None:
    what = _metadata_fault(demonstrations.metadata) or _array_fault(demonstrations)
    if what is not None:
        raise fault(path, what)


def _metadata_fault(metadata: Any) -> str | None:
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        return "is not a file of demonstrations: its metadata lack the format's name"
    if metadata.get("version") != VERSION:
        return (
            f"has version {metadata.get('version')!r} of the format, where this "
            f"program reads version {VERSION}"
        )
    for name, kind in _METADATA.items():
        value = metadata.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):
            return f"has metadata {name}={value!r}, where {kind.__name__} is expected"
    for name, least in (("action_repeat", 1), ("seed", 0), ("first_episode", 0)):
        if metadata[name] < least:
            return f"has metadata {name}={metadata[name]}, which is below {least}"
    return None


def _array_fault(demonstrations: StateDemonstrations) -> str | None:
    rewards = demonstrations.rewards
    if rewards.ndim != 2 or 0 in rewards.shape:
        return f"has rewards of shape {rewards.shape}, where [K, T] is expected"
    num_episodes, num_steps = rewards.shape
    for name, (dtype, num_axes, extra) in _ARRAYS.items():
        array = getattr(demonstrations, name)
        if array.dtype != dtype:
            return f"has {name} of type {array.dtype}, where {dtype} is expected"
        shape = (num_episodes, num_steps + extra)
        if array.ndim != num_axes or array.shape[:2] != shape:
            return (
                f"has {name} of shape {array.shape}, which does not fit rewards of "
                f"shape {rewards.shape}"
            )
        if not np.isfinite(array).all():
            episode = int(np.argwhere(~np.isfinite(array))[0, 0])
            return f"has a NaN or infinity in {name}, episode {episode}"
    returns = demonstrations.metadata["returns"]
    are_numbers = all(isinstance(x, int | float) and abs(x) < 1e300 for x in returns)
    if len(returns) != num_episodes or not are_numbers:
        return f"has metadata returns={returns!r}, where {num_episodes} numbers belong"
    return None
