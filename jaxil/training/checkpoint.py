"""Checkpoints: the learner's arrays by orbax, the replay as one file for each episode.

    DIR/checkpoints/frame_000000010000/   arrays, counters, rewards, list of episodes
    DIR/replay/episode_00000012.npz       written once, never changed

Episode files are written first, then the checkpoint is renamed into place, and old ones
are deleted last. So whenever the process is killed, the newest checkpoint is complete,
and so are all episodes that it needs.

This does not use orbax's CheckpointManager: it stores no checksums, without which a
changed array is restored silently; it renames nothing else into place together with the
arrays; and it deletes a checkpoint of the same frame before it writes the new one.
"""

import functools
import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from flax.traverse_util import unflatten_dict

from jaxil.files import writing
from jaxil.learner.state import LearnerParams
from jaxil.machine import screen
from jaxil.replay import episode_files
from jaxil.replay.replay import Replay
from jaxil.training import learner_files
from jaxil.training import workdir as run_folder
from jaxil.training.workdir import RunFolderError

_NUM_KEPT = 2  # the newest, and the one to fall back to
# All stored rewards, in the order of their episodes: they may be newer than those in
# the episodes' files, which never change.
_REWARDS = "rewards"
_MEAN_IMAGE = "mean_image"


class CheckpointError(RunFolderError):
    """No checkpoint can be used; the message says why and what to do."""


class Checkpoints:
    """Saves and restores a run in its working folder."""

    def __init__(
        self, workdir: str | os.PathLike, *, say: Callable[[str], None] = screen.say
    ):
        """Writes nothing before the first save; `say` tells of what is damaged."""
        # orbax wants absolute paths.
        self._workdir = pathlib.Path(workdir).absolute()
        self._checkpoints = self._workdir / "checkpoints"
        self._replay = self._workdir / "replay"
        self._say = say
        self._last: pathlib.Path | None = None  # saved or restored by this process
        self._num_episodes_saved = 0
        self._checksums: dict[int, int] = {}  # of episodes' files, where known
        self._oldest_episode: dict[pathlib.Path, int] = {}  # needed by each

    def newest(self) -> int | None:
        """Returns the environment frame of the newest checkpoint, or None."""
        return run_folder.newest_checkpoint(self._workdir)

    def save(
        self,
        *,
        frame: int,
        learner_state: Any,
        counters: dict,
        replay: Replay,
        mean_image: np.ndarray | None = None,
    ) -> None:
        """Writes a checkpoint, and the episodes added since the one before.

        Args:
          frame: environment frames so far.
          learner_state: pytree of arrays, typed PRNG keys and None.
          counters: what else the run needs to resume, as JSON: integers of any size
            are kept, tuples come back as lists.
          replay: only read.
          mean_image: what the encoder subtracts, unless that is a constant, so that a
            policy can be used without the demonstrations.

        Raises:
          CheckpointError: the folder has checkpoints and none was restored.
          RunFolderError: a file cannot be written; earlier checkpoints stay usable.
        """
        if self._last is None and self._committed():
            raise CheckpointError(
                f"{self._checkpoints} holds a checkpoint of frame {self.newest()}:"
                " expected none, or to resume from it; restore first or take another"
                " --workdir"
            )
        with run_folder.writes_to(self._workdir):
            for folder in (self._checkpoints, self._replay):
                folder.mkdir(exist_ok=True)
                writing.remove_leftovers(folder)
            # One newer than the one restored is damaged: it goes before its episodes.
            for path in self._committed():
                if self._last is not None and _order(path) > _order(self._last):
                    self._delete(path)

            episodes, added = replay.episodes, replay.num_episodes_added
            for index in episodes:
                if index >= self._num_episodes_saved:
                    checksum = episode_files.write(self._replay, replay, index)
                    self._checksums[index] = checksum
            rewards = [replay.rewards(index) for index in episodes]
            record = {
                "counters": counters,
                "oldest_episode": replay.oldest_episode,
                "num_episodes": added,
                "episodes": episodes,
                "episode_steps": [len(each) for each in rewards],
                "episode_checksums": [self._checksums[index] for index in episodes],
            }
            path = self._free_path(frame)
            with writing.replacing(path) as temporary:
                all_rewards = np.concatenate([*rewards, np.zeros(0, np.float32)])
                arrays = {_REWARDS: all_rewards}
                if mean_image is not None:
                    arrays[_MEAN_IMAGE] = mean_image
                learner_files.write(temporary, learner_state, record, arrays)
            self._remember(path, record)

            kept = self._committed()[-_NUM_KEPT:]
            for path in self._committed()[:-_NUM_KEPT]:
                self._delete(path)
            # A checkpoint of an earlier process may need any episode.
            needed = min(self._oldest_episode.get(path, 0) for path in kept)
            episode_files.remove_except(self._replay, needed, added)

    def restore(self, abstract_learner_state: Any, replay: Replay) -> tuple[Any, dict]:
        """Reads the newest checkpoint, or the one before it if that is damaged.

        Args:
          abstract_learner_state: from jax.eval_shape.
          replay: emptied, then filled with the checkpoint's episodes; damaged ones are
            left out and reported.

        Returns:
          The learner state, on jax's default device, and the counters.

        Raises:
          CheckpointError: there is no checkpoint, none can be read, or it is of another
            learner.
        """
        path, record, learner_state = self._read(
            functools.partial(learner_files.as_state, abstract_learner_state)
        )
        self._refill(replay, record, path / f"{_REWARDS}.npy")
        self._remember(path, record)
        return learner_state, record["counters"]

    def read_policy(self) -> tuple[dict[str, Any], np.ndarray | None, dict]:
        """Reads what it takes to act, from the same checkpoint as `restore`.

        Returns:
          The parameters of encoder, actor and critic by these names; the mean image
          that the encoder subtracts, None where there is none; and the counters.

        Raises:
          CheckpointError: there is no checkpoint, or none can be read.
        """
        path, record, tree = self._read(
            lambda _, arrays: unflatten_dict(arrays, sep=".")
        )
        networks = {name: tree[name]["params"] for name in LearnerParams._fields}
        networks |= tree.get("average", {})  # of encoder and actor, if the run has it
        image = path / f"{_MEAN_IMAGE}.npy"
        return networks, np.load(image) if image.exists() else None, record["counters"]

    def _read(
        self, make: Callable[[dict, dict[str, np.ndarray]], Any]
    ) -> tuple[pathlib.Path, dict, Any]:
        """Returns path, record, and what `make` makes of record and arrays."""
        faults = []
        for path in reversed(self._committed()):
            frame = _order(path)[0]
            try:
                record, arrays = learner_files.read(path)
                made = make(record, arrays)
            except learner_files.OtherLearnerError as error:
                raise CheckpointError(
                    f"{path}: the checkpoint is of another learner: {error}; use the "
                    "configuration that it was made with, or another --workdir"
                ) from error
            except ValueError as error:
                faults.append(f"the checkpoint of frame {frame} is damaged ({error})")
                continue
            if faults:
                self._say(f"{'; '.join(faults)}: using that of frame {frame}")
            return path, record, made
        if not faults:
            raise CheckpointError(
                f"{self._checkpoints}: expected a checkpoint, found none; train first,"
                " or check --workdir"
            )
        raise CheckpointError(
            f"{self._checkpoints}: {'; '.join(faults)}; no checkpoint is left to resume"
            " from, start again in another --workdir"
        )

    def _refill(self, replay: Replay, record: dict, rewards: pathlib.Path) -> None:
        """Fills the replay with the episodes of a checkpoint that can be read."""
        oldest, added = record["oldest_episode"], record["num_episodes"]
        replay.clear(oldest)
        expected = record["episodes"]
        known = dict(zip(expected, record["episode_checksums"], strict=True))
        self._checksums = known.copy()
        faults = []
        for index in range(oldest, added):
            if index not in expected:
                replay.skip_episode()
                continue
            fault = episode_files.read_into(replay, self._replay, index, known[index])
            if fault:
                faults.append(fault)
        if faults:
            more = f" and {len(faults) - 3} more" if len(faults) > 3 else ""
            self._say(
                f"{len(faults)} damaged episodes are left out of the replay "
                f"({'; '.join(faults[:3])}{more}): what follows differs from an "
                "uninterrupted run"
            )
        ends = np.cumsum(record["episode_steps"], dtype=int)[:-1]
        for index, part in zip(expected, np.split(np.load(rewards), ends)):
            if index in replay.episodes:
                replay.replace_rewards(index, part)

    def _remember(self, path: pathlib.Path, record: dict) -> None:
        """Notes the checkpoint that was saved or restored last."""
        self._last = path
        self._num_episodes_saved = record["num_episodes"]
        self._oldest_episode[path] = record["oldest_episode"]

    def _committed(self) -> list[pathlib.Path]:
        """Returns the checkpoints in place, the oldest first."""
        paths = self._checkpoints.glob("frame_*")
        return sorted((path for path in paths if _order(path)), key=_order)

    def _free_path(self, frame: int) -> pathlib.Path:
        # A resumed run that first plays an evaluation it owes saves this frame again.
        path, again = self._checkpoints / f"frame_{frame:012d}", 0
        while path.exists():
            again += 1
            path = path.with_name(f"frame_{frame:012d}_{again}")
        return path

    def _delete(self, path: pathlib.Path) -> None:
        # Renamed first: half a deleted checkpoint must not pass for a whole one.
        doomed = path.with_name(f".deleting_{path.name}")
        os.replace(path, doomed)
        writing.remove(doomed)
        self._oldest_episode.pop(path, None)


def _order(path: pathlib.Path) -> tuple[int, ...]:
    """Returns frame and repetition of a checkpoint; () for any other path."""
    match = run_folder.CHECKPOINT.fullmatch(path.name)
    return (int(match[1]), int(match[2] or 0)) if match else ()
