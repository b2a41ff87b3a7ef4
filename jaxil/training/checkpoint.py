"""Checkpoints: the learner's arrays by orbax, the replay as one file for each episode.

    DIR/checkpoints/frame_000000010000/   arrays, counters, and which episodes they need
    DIR/replay/episode_00000012.npz       written once, never changed

Episode files are written first, then the checkpoint is renamed into place, and old ones
are deleted last. So at any kill the newest checkpoint in place is whole, and so are all
the episodes that it needs.
"""

import json
import os
import pathlib
import re
import shutil
import sys
import uuid
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.replay.episode import Episode
from jaxil.replay.replay import Replay

_NUM_KEPT = 2  # the newest, and the one to fall back to
_FORMAT = 1
_CHECKSUMS = "checksums.json"
# All stored rewards, in the order of their episodes: they may be newer than those in
# the episodes' files, which never change.
_REWARDS = "rewards.npy"
# The second number tells two checkpoints of one frame apart (Ctrl-C after a save).
_CHECKPOINT = re.compile(r"frame_(\d{12,})(?:_(\d+))?")
_EPISODE = re.compile(r"episode_(\d{8,})\.npz")
_UNFINISHED = re.compile(r"\.(saving|deleting|writing)_.*")


class CheckpointError(ValueError):
    """No checkpoint can be used; the message says why and what to do."""


class _Damaged(Exception):
    """One checkpoint cannot be read."""


class Checkpoints:
    """Saves and restores a run in its working folder."""

    def __init__(
        self,
        workdir: str | os.PathLike,
        *,
        say: Callable[[str], None] | None = None,
    ):
        """Looks at the folder; nothing is written before the first save.

        Args:
          workdir: the run's folder.
          say: takes a line for people, e.g. on a damaged checkpoint; None: stderr.
        """
        # orbax wants absolute paths.
        self._checkpoints = pathlib.Path(workdir).absolute() / "checkpoints"
        self._replay = pathlib.Path(workdir).absolute() / "replay"
        self._say = say or _say_on_stderr
        self._last: pathlib.Path | None = None  # saved or restored by this process
        self._num_episodes_saved = 0
        self._oldest_episode: dict[pathlib.Path, int] = {}  # that a checkpoint needs

    def newest(self) -> int | None:
        """Returns the environment frame of the newest checkpoint, or None."""
        paths = self._committed()
        return _order(paths[-1])[0] if paths else None

    def save(
        self, *, frame: int, learner_state: Any, counters: dict, replay: Replay
    ) -> None:
        """Writes a checkpoint, and the episodes added since the one before.

        Args:
          frame: environment frames so far.
          learner_state: pytree of arrays, numbers, typed PRNG keys and None.
          counters: what else the run needs to go on, as JSON can hold it (whole numbers
            of any size included, such as a PCG64's state); tuples come back as lists.
          replay: its episodes are only read.

        Raises:
          CheckpointError: if the folder has checkpoints and none was restored.
          OSError: if a file cannot be written; the checkpoints before stay usable.
        """
        if self._last is None and self._committed():
            raise CheckpointError(
                f"{self._checkpoints} holds a checkpoint of frame {self.newest()}:"
                " expected none, or to go on from it; restore first or take another"
                " --workdir"
            )
        self._checkpoints.mkdir(parents=True, exist_ok=True)
        self._replay.mkdir(exist_ok=True)
        self._clean_up()
        # Newer than the one restored means damaged: it must go before its episodes do.
        for path in self._committed():
            if self._last is not None and _order(path) > _order(self._last):
                self._delete(path)

        oldest, added = replay.oldest_episode, replay.num_episodes_added
        for index in range(max(oldest, self._num_episodes_saved), added):
            _write_episode(self._episode_path(index), replay.episode(index))
        rewards = [replay.rewards(index) for index in range(oldest, added)]
        path = self._free_path(frame)
        self._write(
            path,
            learner_state,
            {"counters": counters, "oldest_episode": oldest, "num_episodes": added},
            np.concatenate([*rewards, np.zeros(0, np.float32)]),
        )
        self._last = path
        self._num_episodes_saved = added
        self._oldest_episode[path] = oldest

        committed = self._committed()
        for path in committed[:-_NUM_KEPT]:
            self._delete(path)
        # A checkpoint of an earlier process may need any episode.
        needed = min(self._oldest_episode.get(p, 0) for p in committed[-_NUM_KEPT:])
        for path in self._replay.iterdir():
            match = _EPISODE.fullmatch(path.name)
            if match and not needed <= int(match[1]) < added:
                path.unlink()

    def restore(
        self, abstract_learner_state: Any, replay: Replay | None = None
    ) -> tuple[Any, dict]:
        """Reads the newest checkpoint, or the one before it if that is damaged.

        Args:
          abstract_learner_state: pytree of the same structure; its leaves (arrays, or
            what jax.eval_shape returns) say shapes, dtypes and types.
          replay: it is emptied and filled with the episodes that were stored then.

        Returns:
          The learner state, on jax's default device, and the counters.

        Raises:
          CheckpointError: if there is no checkpoint, none can be read, or it is of
            another learner.
        """
        faults = []
        for path in reversed(self._committed()):
            frame = _order(path)[0]
            try:
                learner_state, record = self._read(path, abstract_learner_state)
                oldest, added = record["oldest_episode"], record["num_episodes"]
                if replay is not None:
                    replay.clear(oldest)
                    for index in range(oldest, added):
                        _refill(replay, self._episode_path(index))
                    _refill_rewards(replay, path / _REWARDS)
            except _Damaged as error:
                faults.append(f"the checkpoint of frame {frame} is damaged ({error})")
                continue
            if faults:
                self._say(f"{'; '.join(faults)}: going on from frame {frame}")
            self._last = path
            self._num_episodes_saved = added
            self._oldest_episode[path] = oldest
            return learner_state, record["counters"]
        if replay is not None:
            replay.clear()
        if not faults:
            raise CheckpointError(
                f"{self._checkpoints}: expected a checkpoint, found none; train first,"
                " or check --workdir"
            )
        raise CheckpointError(
            f"{self._checkpoints}: {'; '.join(faults)}; no checkpoint is left to go on"
            " from, start again in another --workdir"
        )

    def _write(
        self,
        path: pathlib.Path,
        learner_state: Any,
        record: dict,
        rewards: np.ndarray,
    ) -> None:
        import orbax.checkpoint as ocp  # slow to import

        arrays, leaves = {}, {}
        for name, leaf in _named_leaves(learner_state):
            key_type = None
            if _is_key(leaf):
                key_type = str(jax.random.key_impl(leaf))
                leaf = jax.random.key_data(leaf)
            array = np.asarray(leaf)
            # orbax writes no empty arrays; the shape in the record says all of them.
            if array.size:
                arrays[name] = array
            leaves[name] = {
                "shape": list(array.shape),
                "dtype": str(array.dtype),
                "key_type": key_type,
            }
        record = {**record, "format": _FORMAT, "leaves": leaves}
        # Into a folder of our own and renamed at the end: however orbax commits on this
        # file system, a checkpoint that bears its name is whole.
        temporary = self._checkpoints / f".saving_{uuid.uuid4().hex}"
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
            checkpointer.save(
                temporary,
                args=ocp.args.Composite(
                    learner=ocp.args.PyTreeSave(arrays),
                    record=ocp.args.JsonSave(record),
                ),
            )
        np.save(temporary / _REWARDS, rewards)
        checksums = json.dumps(_checksums(temporary))
        (temporary / _CHECKSUMS).write_text(checksums)
        os.replace(temporary, path)

    def _read(self, path: pathlib.Path, abstract_state: Any) -> tuple[Any, dict]:
        import orbax.checkpoint as ocp

        try:
            # Before orbax sees it: on a damaged file, orbax leaves tracebacks of its
            # threads on the screen, and what was changed within an array passes.
            if _checksums(path) != json.loads((path / _CHECKSUMS).read_text()):
                raise ValueError("its files are not as they were written")
            with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
                restored = checkpointer.restore(
                    path,
                    args=ocp.args.Composite(
                        learner=ocp.args.PyTreeRestore(), record=ocp.args.JsonRestore()
                    ),
                )
            record, leaves = restored.record, restored.record["leaves"]
            arrays = {}
            for name, leaf in leaves.items():
                array = np.asarray(restored.learner.get(name, ()), leaf["dtype"])
                arrays[name] = array.reshape(leaf["shape"])
        except Exception as error:  # orbax and tensorstore raise whatever they meet
            raise _Damaged(_one_line(error)) from error

        named = dict(_named_leaves(abstract_state))
        faults = [f"{name} is missing" for name in named if name not in leaves]
        faults += [f"{name} is unknown" for name in leaves if name not in named]
        state_leaves = []
        for name, like in named.items():
            if name in leaves:
                leaf = _as_leaf(arrays[name], leaves[name]["key_type"], like)
                if _kind(leaf) != _kind(like):
                    faults.append(f"{name} is {_kind(leaf)}, expected {_kind(like)}")
                state_leaves.append(leaf)
        if faults:
            more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
            raise CheckpointError(
                f"{path}: the checkpoint is of another learner: {'; '.join(faults[:5])}"
                f"{more}; use the configuration that it was made with, or another"
                " --workdir"
            )
        structure = jax.tree.structure(abstract_state)
        return jax.tree.unflatten(structure, state_leaves), record

    def _committed(self) -> list[pathlib.Path]:
        """Returns the checkpoints in place, the oldest first."""
        if not self._checkpoints.is_dir():
            return []
        paths = self._checkpoints.iterdir()
        return sorted((p for p in paths if _CHECKPOINT.fullmatch(p.name)), key=_order)

    def _free_path(self, frame: int) -> pathlib.Path:
        path, again = self._checkpoints / f"frame_{frame:012d}", 0
        while path.exists():
            again += 1
            path = path.with_name(f"frame_{frame:012d}_{again}")
        return path

    def _episode_path(self, index: int) -> pathlib.Path:
        return self._replay / f"episode_{index:08d}.npz"

    def _delete(self, path: pathlib.Path) -> None:
        # Renamed first: half a deleted checkpoint must not pass for a whole one.
        doomed = path.with_name(f".deleting_{uuid.uuid4().hex}")
        os.replace(path, doomed)
        shutil.rmtree(doomed)
        self._oldest_episode.pop(path, None)

    def _clean_up(self) -> None:
        """Removes what earlier processes were killed over."""
        for folder in (self._checkpoints, self._replay):
            for path in folder.iterdir():
                if not _UNFINISHED.fullmatch(path.name):
                    continue
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()


def _order(path: pathlib.Path) -> tuple[int, int]:
    match = _CHECKPOINT.fullmatch(path.name)
    assert match is not None, path
    return int(match[1]), int(match[2] or 0)


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Lists the leaves with a name each, like actor.params.trunk.kernel."""
    paths_and_leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [
        (jax.tree_util.keystr(path, simple=True, separator="."), leaf)
        for path, leaf in paths_and_leaves
    ]


def _is_key(leaf: Any) -> bool:
    dtype = getattr(leaf, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)


def _as_leaf(array: np.ndarray, key_type: str | None, like: Any) -> Any:
    if isinstance(like, bool | int | float):
        return array.item()
    if isinstance(like, np.ndarray | np.generic):
        return array
    if key_type is not None:
        return jax.random.wrap_key_data(jnp.asarray(array), impl=key_type)
    # A copy, because the learner donates its state: jax must own this memory.
    return jnp.array(array, copy=True)


def _kind(leaf: Any) -> str:
    if isinstance(leaf, bool | int | float):
        return type(leaf).__name__
    return f"{leaf.dtype}{list(leaf.shape)}"


def _checksums(folder: pathlib.Path) -> dict[str, int]:
    """Sums up each file in a folder, by its path in it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): zlib.crc32(path.read_bytes())
        for path in files
        if path.name != _CHECKSUMS
    }


def _write_episode(path: pathlib.Path, episode: Episode) -> None:
    """Writes one episode as an .npz, as a whole or not at all."""
    temporary = path.with_name(f".writing_{uuid.uuid4().hex}.npz")
    try:
        with temporary.open("wb") as file:
            # np.savez_compressed packs at level 6: slower by far, little smaller.
            with zipfile.ZipFile(
                file, "w", zipfile.ZIP_DEFLATED, compresslevel=1
            ) as archive:
                for name, array in episode._asdict().items():
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                        np.lib.format.write_array(member, array, allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _refill(replay: Replay, path: pathlib.Path) -> None:
    """Reads one episode into the replay."""
    try:
        # Opened here: np.load leaves a file that it cannot read open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            replay.add_episode(**{name: archive[name] for name in Episode._fields})
    except (
        OSError,
        ValueError,
        KeyError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise _Damaged(f"{path.name}: {_one_line(error)}") from error


def _refill_rewards(replay: Replay, path: pathlib.Path) -> None:
    """Gives the replay's episodes the rewards that they had when they were saved."""
    if not path.exists():  # a checkpoint from before rewards were part of it
        return
    try:
        rewards = np.load(path, allow_pickle=False)
        first = 0
        for index in range(replay.oldest_episode, replay.num_episodes_added):
            last = first + len(replay.rewards(index))
            replay.replace_rewards(index, rewards[first:last])
            first = last
        if first != len(rewards):
            raise ValueError(f"{len(rewards)} rewards for {first} steps")
    except (OSError, ValueError, EOFError) as error:
        raise _Damaged(f"{path.name}: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    first = next(iter(str(error).strip().splitlines()), "")
    return f"{type(error).__name__}: {first[:160]}" if first else type(error).__name__


def _say_on_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
