"""Checkpoints after kills, damage and on full disks."""

import errno
import pathlib
import random
import shutil
import subprocess
import sys
import time

import numpy as np
import orbax.checkpoint
import pytest

from jaxil.training import learner_files
from jaxil.training.checkpoint import CheckpointError, Checkpoints
from jaxil.training.workdir import RunFolderError
from tests.files.damaged_archives import set_header_byte
from tests.training.saved_runs import (
    add_episodes,
    assert_same_replay,
    assert_same_state,
    make_replay,
    make_state,
    restore,
    save,
)


def flip_a_bit(workdir, name: str, seed: int) -> None:
    """Damages one file of a checkpoint."""
    rng = random.Random(seed)
    paths = (workdir / "checkpoints" / name).rglob("*")
    path = rng.choice(sorted(p for p in paths if p.is_file() and p.stat().st_size))
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("moment", ["episodes", "orbax", "rename", "deletion"])
def test_a_kill_in_mid_save_leaves_a_whole_checkpoint(tmp_path, monkeypatch, moment):
    checkpoints, replay = Checkpoints(tmp_path), make_replay(3)
    save(checkpoints, 1, replay, note="first")
    add_episodes(replay, 2)
    save(checkpoints, 2, replay, note="second")
    add_episodes(replay, 2)

    class Killed(BaseException):
        pass

    def kill(*_, **__):
        raise Killed

    with monkeypatch.context() as patched:
        if moment == "episodes":
            write = np.lib.format.write_array

            def die_in_the_second(file, array, **options):
                if (tmp_path / "replay" / "episode_00000005.npz").exists():
                    raise Killed
                write(file, array, **options)

            patched.setattr("numpy.lib.format.write_array", die_in_the_second)
        elif moment == "orbax":
            write_all = orbax.checkpoint.Checkpointer.save

            def write_half(self, folder, **options):
                write_all(self, folder, **options)
                for path in sorted(folder.rglob("*"))[::2]:
                    if path.is_file():
                        path.unlink()
                raise Killed

            patched.setattr(orbax.checkpoint.Checkpointer, "save", write_half)
        elif moment == "rename":
            patched.setattr(
                "jaxil.files.writing.os.replace",
                lambda old, new: kill() if "frame_" in str(new) else old.rename(new),
            )
        else:
            patched.setattr("jaxil.files.writing.shutil.rmtree", kill)
        with pytest.raises(Killed):
            save(checkpoints, 3, replay, note="third")

    survivor, restored, state, counters, _ = restore(tmp_path)
    if moment == "deletion":  # the third was in place already
        assert counters == {"note": "third"}
        assert_same_replay(replay, restored)
    else:
        assert counters == {"note": "second"}
        assert_same_state(make_state(2), state)
        assert_same_replay(make_replay(5), restored)

    # The resumed run rewrites episode 5, leftovers are removed, all is whole again.
    add_episodes(restored, 1)
    save(survivor, 4, restored, note="fourth")
    again = restore(tmp_path)
    assert again.counters == {"note": "fourth"}
    assert_same_replay(restored, again.replay)
    leftovers = [p for p in tmp_path.rglob("*") if p.name.startswith(".")]
    assert leftovers == []


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_newest_checkpoint_falls_back(tmp_path, seed):
    checkpoints, replay = Checkpoints(tmp_path), make_replay(4)
    save(checkpoints, 1, replay)
    add_episodes(replay, 2)
    save(checkpoints, 2, replay)
    flip_a_bit(tmp_path, "frame_000000000002", seed)
    survivor, restored, state, _, (said,) = restore(tmp_path)
    assert_same_state(make_state(1), state)
    assert_same_replay(make_replay(4), restored)
    assert said.startswith("the checkpoint of frame 2 is damaged (")
    assert said.endswith(": using that of frame 1")
    assert "\n" not in said
    # Resumed: another episode 4 than the damaged checkpoint knew, and another frame 2.
    add_episodes(restored, 1, num_steps=3)
    save(survivor, 2, restored)
    again = restore(tmp_path)
    assert_same_replay(restored, again.replay)
    assert not again.said


def test_a_checkpoint_of_another_version_is_not_read_as_this_one(tmp_path, monkeypatch):
    checkpoints, replay = Checkpoints(tmp_path), make_replay(4)
    save(checkpoints, 1, replay)
    monkeypatch.setattr(learner_files, "_FORMAT", 2)
    save(checkpoints, 2, replay)
    monkeypatch.undo()
    _, _, state, _, (said,) = restore(tmp_path)
    assert_same_state(make_state(1), state)
    assert "another version of jaxil wrote it" in said


def _become_a_folder(path):
    path.unlink()
    (path / "inner").mkdir(parents=True)


DAMAGES = {
    "missing": lambda path: path.unlink(),
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "empty": lambda path: path.write_bytes(b""),
    "a folder": _become_a_folder,
    "other shape": lambda path: np.savez(
        path, frames=1, actions=1, rewards=1, discounts=1
    ),
    "encrypted": lambda path: set_header_byte(path, 6, 1),
    "unknown compression": lambda path: set_header_byte(path, 8, 99),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_episode_is_left_out_and_named(tmp_path, damage):
    checkpoints, replay = Checkpoints(tmp_path), make_replay(3)
    save(checkpoints, 1, replay)
    DAMAGES[damage](tmp_path / "replay" / "episode_00000001.npz")
    checkpoints, restored, state, _, (said,) = restore(tmp_path)
    assert_same_state(make_state(1), state)
    assert restored.episodes == [0, 2]
    for index in restored.episodes:
        for a, b in zip(restored.episode(index), replay.episode(index), strict=True):
            np.testing.assert_array_equal(a, b)
    assert said.startswith("1 damaged episodes are left out of the replay (episode_")
    assert "episode_00000001.npz: " in said
    # Resumed: its numbers go on, and later checkpoints have the gap without a word,
    # until the ring has moved past it.
    for frame in range(2, 6):
        add_episodes(restored, 1)
        save(checkpoints, frame, restored)
        again = restore(tmp_path)
        assert_same_replay(restored, again.replay)
        assert not again.said
    assert again.replay.episodes == [4, 5, 6]
    assert not (tmp_path / "replay" / "episode_00000001.npz").exists()


def test_exchanged_episodes_are_noticed(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay(3))
    first, second = (
        tmp_path / "replay" / f"episode_{index:08d}.npz" for index in (0, 2)
    )
    first.rename(tmp_path / "aside")
    second.rename(first)
    (tmp_path / "aside").rename(second)
    restored = restore(tmp_path)
    assert restored.replay.episodes == [1]
    assert "episode_00000000.npz: has changed since it was written" in restored.said[0]


def test_a_forged_episode_is_noticed_also_after_a_second_save(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay(2))
    resumed = restore(tmp_path)
    save(resumed.checkpoints, 2, resumed.replay)
    path = tmp_path / "replay" / "episode_00000001.npz"
    arrays = dict(np.load(path))
    arrays["rewards"] += 1
    np.savez(path, **arrays)  # with right checksums of its own
    restored = restore(tmp_path)
    assert restored.replay.episodes == [0]
    assert "episode_00000001.npz: has changed since it was written" in restored.said[0]


def test_without_any_episode_the_learner_is_resumed(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay(5))
    shutil.rmtree(tmp_path / "replay")
    restored = restore(tmp_path)
    assert restored.replay.episodes == []
    assert restored.replay.num_episodes_added == 5
    assert len(restored.said) == 1
    add_episodes(restored.replay, 1)
    save(restored.checkpoints, 2, restored.replay)
    assert restore(tmp_path).replay.episodes == [5]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: (path / "checksums.json").write_text("[" * 200_000),
        lambda path: (path / "checksums.json").write_text("{}"),
        lambda path: (path / "checksums.json").write_bytes(b"\xff"),
        lambda path: (shutil.rmtree(path), path.write_text("a file")),
        lambda path: (shutil.rmtree(path), path.mkdir()),
    ],
    ids=["deep JSON", "no sums", "not UTF-8", "a file", "empty"],
)
def test_an_odd_newest_checkpoint_falls_back(tmp_path, spoil):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    save(checkpoints, 1, replay)
    save(checkpoints, 2, replay)
    spoil(tmp_path / "checkpoints" / "frame_000000000002")
    restored = restore(tmp_path)
    assert_same_state(make_state(1), restored.state)
    assert len(restored.said) == 1
    save(restored.checkpoints, 3, restored.replay)  # which removes it
    assert Checkpoints(tmp_path).newest() == 3
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["frame_000000000001", "frame_000000000003"]


@pytest.mark.parametrize("what", ["episode", "room", "learner", "folder"])
def test_a_full_disk_leaves_the_checkpoint_before(tmp_path, monkeypatch, what):
    checkpoints, replay = Checkpoints(tmp_path), make_replay(1)
    save(checkpoints, 1, replay)
    add_episodes(replay, 1)

    def fail(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    def fail_in_tensorstore(*_, **__):
        name = "x" * 300
        raise ValueError(
            f"RESOURCE_EXHAUSTED: Error writing {name}: Failed to write 59188 bytes to "
            "file 15: No space left on device [os_error_code='28']"
        )

    with monkeypatch.context() as patched:
        if what == "episode":
            patched.setattr(np.lib.format, "write_array", fail)
        elif what == "room":
            patched.setattr("os.posix_fallocate", fail)
            patched.setattr(orbax.checkpoint.Checkpointer, "save", None)
        elif what == "learner":
            patched.setattr(orbax.checkpoint.Checkpointer, "save", fail_in_tensorstore)
        else:
            patched.setattr("jaxil.files.writing.os.replace", fail)
        with pytest.raises(RunFolderError, match=r"No space left.*of frame 1\. Make"):
            save(checkpoints, 2, replay)

    save(checkpoints, 2, replay)  # there is room again
    assert_same_replay(replay, restore(tmp_path).replay)


def test_a_folder_that_was_moved_is_not_made_again(tmp_path):
    folder, replay = tmp_path / "run", make_replay()
    folder.mkdir()
    checkpoints = Checkpoints(folder)
    save(checkpoints, 1, replay)
    folder.rename(tmp_path / "moved")
    with pytest.raises(RunFolderError, match="deleted or moved"):
        save(checkpoints, 2, replay)
    assert not folder.exists()
    assert Checkpoints(tmp_path / "moved").newest() == 1


def test_when_all_are_damaged(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for frame in (1, 2):
        save(checkpoints, frame, make_replay())
    for name in ("frame_000000000001", "frame_000000000002"):
        flip_a_bit(tmp_path, name, 0)
    with pytest.raises(
        CheckpointError, match=r"frame 2 is damaged.*frame 1 is damaged"
    ):
        restore(tmp_path)


ROOT = pathlib.Path(__file__).parents[2]

SAVE_FOREVER = """
import itertools, sys
from tests.training import saved_runs
checkpoints, replay = saved_runs.Checkpoints(sys.argv[1]), saved_runs.make_replay()
first = 1
if checkpoints.newest() is not None:
    first = checkpoints.restore(saved_runs.ABSTRACT, replay)[1]["episodes"] + 1
for frame in itertools.count(first):
    saved_runs.add_episodes(replay, 1)
    saved_runs.save(checkpoints, frame, replay, episodes=frame)
    print(frame, flush=True)
"""


def test_sigkill_at_any_moment(tmp_path):
    rng = random.Random(0)
    for _ in range(2):
        command = [sys.executable, "-c", SAVE_FOREVER, str(tmp_path)]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, cwd=ROOT
        ) as process:
            assert process.stdout is not None
            lines = [process.stdout.readline() for _ in range(3)]
            time.sleep(rng.uniform(0, 0.3))
            process.kill()
        restored = restore(tmp_path)
        episodes = restored.counters["episodes"]
        assert episodes >= int(lines[-1])
        assert_same_state(make_state(episodes), restored.state)
        assert_same_replay(make_replay(episodes), restored.replay)
