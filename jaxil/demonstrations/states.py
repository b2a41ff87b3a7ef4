"""The file format of recorded demonstrations: simulator states instead of pixels.

A NumPy archive (.npz) of K episodes of T agent steps:

    qpos, qvel, act   float64 [K, T + 1, nq], [K, T + 1, nv], [K, T + 1, na]
    actions, rewards  float32 [K, T, A], [K, T]
    metadata          JSON text, see `new_metadata`

Pixels would take a thousand times the space and would not match another machine's
renderer.
"""

import hashlib
import json
import os
import pathlib
from typing import Any, NamedTuple

import numpy as np

from jaxil.demonstrations.types import returns_of
from jaxil.environments import suite
from jaxil.errors import printable
from jaxil.files import archive
from jaxil.machine import devices

FORMAT = "jaxil-demonstrations"
VERSION = 1
_MAX_METADATA_BYTES = 1024**2
_ARRAYS = {  # name: dtype, number of axes, entries beyond T
    "qpos": (np.dtype(np.float64), 3, 1),
    "qvel": (np.dtype(np.float64), 3, 1),
    "act": (np.dtype(np.float64), 3, 1),
    "actions": (np.dtype(np.float32), 3, 0),
    "rewards": (np.dtype(np.float32), 2, 0),
}
_METADATA = {
    "task": str,
    "action_repeat": int,
    "versions": dict,
    "seed": int,
    "first_episode": int,
    "expert": str,
    "returns": list,
}
_CHECK_PATH = "Check the path in demonstrations.source"
_REMAKE = "Record it again with `jaxil collect`, or use another file"


class DemonstrationError(ValueError):
    """Demonstrations cannot be used; the message names file, reason and remedy.

    All functions of this module raise it for a file that cannot be read or is invalid.
    """


class StateDemonstrations(NamedTuple):
    """The content of a file; shapes as above.

    Actions are in [-1, 1]; rewards are the task's, summed over the action repeat.
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
        """Returns `qpos`, `qvel` and `act` of the given episodes and times."""
        names = ("qpos", "qvel", "act")
        return {name: getattr(self, name)[episodes, times] for name in names}


def new_metadata(
    *,
    task: str,
    action_repeat: int,
    seed: int,
    expert: str,
    rewards: np.ndarray,
) -> dict[str, Any]:
    """Returns the metadata of newly recorded episodes 0 ... K - 1.

    Args:
      task: its name, as in configs.
      action_repeat: environment frames per stored step.
      seed: of the recording environment; with an episode's number it restores what is
        randomized outside the state.
      expert: how the expert was made, in words.
      rewards: the task's, summed over the action repeat. Shape [K, T].
    """
    return {
        "format": FORMAT,
        "version": VERSION,
        "task": task,
        "action_repeat": action_repeat,
        "versions": {
            **suite.simulator_versions(),
            "jaxil": devices.version("jaxil") or devices.NOT_INSTALLED,
        },
        "seed": seed,
        "first_episode": 0,
        "expert": expert,
        "returns": returns_of(rewards),
    }


def shipped_tasks() -> tuple[str, ...]:
    """Returns the tasks with shipped demonstrations, sorted."""
    return tuple(sorted(path.stem for path in _shipped_folder().glob("*.npz")))


def shipped_path(task: str) -> pathlib.Path:
    """Returns the file of a task's shipped demonstrations."""
    path = _shipped_folder() / f"{task}.npz"
    if task not in shipped_tasks():
        raise DemonstrationError(
            f"no demonstrations of {task} are shipped, only of: "
            f"{', '.join(shipped_tasks()) or 'no task'}. Record some with "
            "`jaxil collect`, and set demonstrations.source to the file."
        )
    return path


def located(name: str) -> pathlib.Path:
    """Returns the path of a file or folder, or of a task's shipped demonstrations."""
    path = pathlib.Path(name)
    if os.path.exists(path):
        return path
    if name in shipped_tasks():
        return shipped_path(name)
    raise DemonstrationError(
        f"{printable(name)}: no such file or folder, and no task with shipped "
        f"demonstrations; these are {', '.join(shipped_tasks())}"
    )


def digest(path: pathlib.Path) -> str:
    """Returns a digest of the content of a file or folder, whatever its name."""
    total = hashlib.blake2b(digest_size=16)
    try:
        parts = sorted(path.rglob("*")) if path.is_dir() else [path]
        for part in parts:
            if part.is_file():
                with part.open("rb") as file:
                    one = hashlib.file_digest(file, "blake2b")
                name = "" if part == path else part.relative_to(path).as_posix()
                total.update(f"{name} {one.hexdigest()}\n".encode())
    except OSError as error:
        raise unreadable(path, error) from error
    return total.hexdigest()


def write_states(path: str | os.PathLike, demonstrations: StateDemonstrations) -> None:
    """Writes a file atomically."""
    path = pathlib.Path(path)
    _check(path, demonstrations)
    arrays = {
        name: getattr(demonstrations, name).astype(dtype)
        for name, (dtype, _, _) in _ARRAYS.items()
    }
    arrays["metadata"] = np.array(json.dumps(demonstrations.metadata))
    archive.write_archive(path, arrays.items())


def recognises(path: pathlib.Path) -> bool:
    """Returns whether a file has this format, by the names of its arrays."""
    return "qpos" in archive.member_names(path)


def read_states(
    path: str | os.PathLike,
    *,
    task: str | None = None,
    num_episodes: int | None = None,
    takes_fewer: bool = False,
) -> StateDemonstrations:
    """Reads and checks a whole file, without rendering.

    Args:
      path: the file.
      task: the required task; None for any.
      num_episodes: returns the first ones; None for all.
      takes_fewer: whether fewer episodes than `num_episodes` will do.
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
    if num_episodes is None or (takes_fewer and num_episodes >= stored):
        return demonstrations
    if not 1 <= num_episodes <= stored:
        what = f"holds {stored} episodes, but num_episodes={num_episodes}"
        raise fault(path, what, f"Use 1 to {stored} as demonstrations.num_episodes")
    kept = [array[:num_episodes] for array in demonstrations[:-1]]
    metadata = {**metadata, "returns": metadata["returns"][:num_episodes]}
    return StateDemonstrations(*kept, metadata=metadata)


def _shipped_folder() -> pathlib.Path:
    return pathlib.Path(__file__).parent


def fault(path: pathlib.Path, what: str, way_out: str = _REMAKE) -> DemonstrationError:
    """Returns the error for a file; `way_out` is the remedy."""
    return DemonstrationError(f"{printable(path)} {printable(what)}. {way_out}.")


def other_task(path: pathlib.Path, shown: str, task: str) -> DemonstrationError:
    """Returns the error for a file of another task."""
    return fault(path, f"shows {shown}, but the task is {task}", "Change one of them")


def unreadable(path: pathlib.Path, error: OSError) -> DemonstrationError:
    """Returns the error for a file that cannot be opened."""
    return fault(path, f"cannot be read ({error.strerror or error})", _CHECK_PATH)


def _check(path: pathlib.Path, demonstrations: StateDemonstrations) -> None:
    if what := _metadata_fault(demonstrations.metadata) or _array_fault(demonstrations):
        raise fault(path, what)


def _metadata_fault(metadata: Any) -> str | None:
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        return "is not a file of demonstrations: its metadata lack the format name"
    if metadata.get("version") != VERSION:
        return f"has version {metadata.get('version')!r} of the format, not {VERSION}"
    for name, kind in _METADATA.items():
        value = metadata.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):
            return f"has metadata {name}={value!r}, but {kind.__name__} is expected"
    for name, least in (("action_repeat", 1), ("seed", 0), ("first_episode", 0)):
        if not least <= metadata[name] < 2**63:
            return f"has metadata {name}={metadata[name]}, not in [{least}, 2**63)"
    return None


def _array_fault(demonstrations: StateDemonstrations) -> str | None:
    rewards = demonstrations.rewards
    if rewards.ndim != 2 or 0 in rewards.shape:
        return f"has rewards of shape {rewards.shape}, but [K, T] is expected"
    num_episodes, num_steps = rewards.shape
    for name, (dtype, num_axes, extra) in _ARRAYS.items():
        array = getattr(demonstrations, name)
        if array.dtype != dtype:
            return f"has {name} of type {array.dtype}, but {dtype} is expected"
        shape = (num_episodes, num_steps + extra)
        if array.ndim != num_axes or array.shape[:2] != shape:
            return f"has {name} of shape {array.shape} for rewards of {rewards.shape}"
        if not np.isfinite(array).all():
            episode = int(np.argwhere(~np.isfinite(array))[0, 0])
            return f"has a NaN or infinity in {name}, episode {episode}"
    returns = demonstrations.metadata["returns"]
    are_numbers = all(isinstance(x, int | float) and abs(x) < 1e300 for x in returns)
    if len(returns) != num_episodes or not are_numbers:
        return f"has metadata returns={returns!r}, but {num_episodes} are expected"
    return None
