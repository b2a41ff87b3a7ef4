"""Checkpoints: round trips, increments, kills in mid-save, damage."""

import errno
import pathlib
import random
import shutil
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint
import pytest

from jaxil.replay.replay import Replay
from jaxil.training import learner_files
from jaxil.training.checkpoint import CheckpointError, Checkpoints
from jaxil.training.workdir import RunFolderError


def make_replay() -> Replay:
    return Replay(
        capacity_steps=12,
        episode_steps=4,
        observation_shape=(4, 4, 3),
        observation_dtype=np.uint8,
        action_dim=2,
        frame_stack=2,
        num_steps=2,
        discount_factor=0.9,
    )


def add_episodes(replay: Replay, count: int, num_steps: int = 4) -> None:
    for _ in range(count):
        rng = np.random.default_rng(replay.num_episodes_added)
        replay.add_episode(
            frames=rng.integers(0, 256, (num_steps + 1, 4, 4, 3), dtype=np.uint8),
            actions=rng.normal(size=(num_steps, 2)),
            rewards=rng.normal(size=num_steps),
            discounts=np.ones(num_steps),
        )


def make_state(seed: int) -> dict:
    key = jax.random.key(seed)
    return {
        "actor": [{"kernel": jax.random.normal(key, (3, 5))}, None],
        "key": key,
        "keys": jax.random.split(jax.random.key(seed, impl="rbg"), 2),
        "num_updates": jnp.int32(seed),
        "half": jnp.full((2,), 1.5, jnp.bfloat16),
        "empty": jnp.zeros((0, 4)),
        "flag": jnp.array(True),
    }


ABSTRACT = jax.eval_shape(lambda: make_state(0))


def assert_same_state(one, other) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def assert_same_replay(one: Replay, other: Replay) -> None:
    assert one.episodes == other.episodes
    assert one.num_episodes_added == other.num_episodes_added
    for index in one.episodes:
        for a, b in zip(one.episode(index), other.episode(index), strict=True):
            np.testing.assert_array_equal(a, b)


def episode_files_of(workdir) -> dict:
    """Names of the episode files, with what tells whether one was written again."""
    stats = {path.name: path.stat() for path in (workdir / "replay").iterdir()}
    return {name: (stat.st_ino, stat.st_mtime_ns) for name, stat in stats.items()}


def save(checkpoints, frame: int, replay: Replay, **counters) -> None:
    checkpoints.save(
        frame=frame, learner_state=make_state(frame), counters=counters, replay=replay
    )


def flip_a_bit(workdir, name: str, seed: int) -> None:
    """Damages one file of a checkpoint."""
    rng = random.Random(seed)
    paths = (workdir / "checkpoints" / name).rglob("*")
    path = rng.choice(sorted(p for p in paths if p.is_file() and p.stat().st_size))
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(bytes(content))


def test_everything_comes_back(tmp_path):
    replay = make_replay()
    add_episodes(replay, 5)
    generator = np.random.default_rng(3)
    generator.normal(size=7)
    counters = {
        "frame": 10,
        "seconds": 1 / 3,
        "generator": generator.bit_generator.state,
    }
    Checkpoints(tmp_path).save(
        frame=10, learner_state=make_state(3), counters=counters, replay=replay
    )

    checkpoints, restored = Checkpoints(tmp_path), make_replay()
    state, counters_back = checkpoints.restore(ABSTRACT, restored)

    assert checkpoints.newest() == 10
    assert_same_state(make_state(3), state)
    assert counters_back == counters
    assert_same_replay(replay, restored)
    draws = [r.sample(np.random.default_rng(0), 16) for r in (replay, restored)]
    for a, b in zip(*draws, strict=True):
        np.testing.assert_array_equal(a, b)


def test_leaves_come_back_as_what_they_were(tmp_path):
    state = {"count": 3, "scale": 0.5, "mean": np.arange(3), "bias": jnp.ones(2)}
    Checkpoints(tmp_path).save(
        frame=0, learner_state=state, counters={}, replay=make_replay()
    )

    restored, _ = Checkpoints(tmp_path).restore(state)

    assert type(restored["count"]) is int
    assert type(restored["scale"]) is float
    assert type(restored["mean"]) is np.ndarray
    assert isinstance(restored["bias"], jax.Array)
    # Restored arrays are free to be donated, again and again.
    double = jax.jit(lambda x: x * 2, donate_argnums=0)
    np.testing.assert_array_equal(double(double(restored["bias"])), [4, 4])


def test_episodes_are_written_once_and_go_after_the_checkpoints_that_need_them(
    tmp_path,
):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    add_episodes(replay, 2)
    save(checkpoints, 1, replay)
    before = episode_files_of(tmp_path)
    add_episodes(replay, 2)  # 0 is evicted: three fit
    save(checkpoints, 2, replay)
    after = episode_files_of(tmp_path)

    assert len(before) == 2
    assert set(after) == {f"episode_{i:08d}.npz" for i in range(4)}
    assert {name: after[name] for name in before} == before

    add_episodes(replay, 1)
    save(checkpoints, 3, replay)

    # Kept are the checkpoints 2 (episodes 1 to 3) and 3 (2 to 4).
    assert set(episode_files_of(tmp_path)) == {
        f"episode_{i:08d}.npz" for i in range(1, 5)
    }
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["frame_000000000002", "frame_000000000003"]


def test_a_resumed_run_writes_only_what_is_new(tmp_path):
    replay = make_replay()
    add_episodes(replay, 3)
    save(Checkpoints(tmp_path), 1, replay)
    before = episode_files_of(tmp_path)

    checkpoints, resumed = Checkpoints(tmp_path), make_replay()
    checkpoints.restore(ABSTRACT, resumed)
    add_episodes(resumed, 2)
    save(checkpoints, 2, resumed)
    add_episodes(replay, 2)

    after = episode_files_of(tmp_path)
    assert {name: after[name] for name in before} == before
    again = make_replay()
    Checkpoints(tmp_path).restore(ABSTRACT, again)
    assert_same_replay(replay, again)


@pytest.mark.parametrize("moment", ["episodes", "orbax", "rename", "deletion"])
def test_a_kill_in_mid_save_leaves_a_whole_checkpoint(tmp_path, monkeypatch, moment):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    add_episodes(replay, 3)
    save(checkpoints, 1, replay, note="first")
    add_episodes(replay, 2)
    save(checkpoints, 2, replay, note="second")
    at_second = make_replay()
    add_episodes(at_second, 5)
    add_episodes(replay, 2)

    class Killed(BaseException):
        pass

    def kill(*_, **__):
        raise Killed

    with monkeypatch.context() as patched:
        if moment == "episodes":
            write = np.lib.format.write_array

            def die_in_the_second(file, array, **options):
                if "episode_00000005.npz" in episode_files_of(tmp_path):
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

    survivor, restored = Checkpoints(tmp_path), make_replay()
    state, counters = survivor.restore(ABSTRACT, restored)
    if moment == "deletion":  # the third was in place already
        assert counters == {"note": "third"}
        assert_same_replay(replay, restored)
    else:
        assert counters == {"note": "second"}
        assert_same_state(make_state(2), state)
        assert_same_replay(at_second, restored)

    # The resumed run rewrites episode 5, leftovers are removed, all is whole again.
    add_episodes(restored, 1)
    save(survivor, 4, restored, note="fourth")
    again = make_replay()
    _, counters = Checkpoints(tmp_path).restore(ABSTRACT, again)
    assert counters == {"note": "fourth"}
    assert_same_replay(restored, again)
    leftovers = [p for p in tmp_path.rglob("*") if p.name.startswith(".")]
    assert leftovers == []


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_newest_checkpoint_falls_back(tmp_path, seed):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    add_episodes(replay, 4)
    save(checkpoints, 1, replay)
    at_first = make_replay()
    add_episodes(at_first, 4)
    add_episodes(replay, 2)
    save(checkpoints, 2, replay)
    flip_a_bit(tmp_path, "frame_000000000002", seed)

    said = []
    survivor, restored = Checkpoints(tmp_path, say=said.append), make_replay()
    state, _ = survivor.restore(ABSTRACT, restored)

    assert_same_state(make_state(1), state)
    assert_same_replay(at_first, restored)
    assert len(said) == 1
    assert said[0].startswith("the checkpoint of frame 2 is damaged (")
    assert said[0].endswith(": using that of frame 1")
    assert "\n" not in said[0]

    # Resumed: another episode 4 than the damaged checkpoint knew, and another frame 2.
    add_episodes(restored, 1, num_steps=3)
    save(survivor, 2, restored)
    again = make_replay()
    Checkpoints(tmp_path, say=said.append).restore(ABSTRACT, again)
    assert_same_replay(restored, again)
    assert len(said) == 1


def _flag_members(path, offset, value):
    """Changes one field of the zip's headers: what a member says of itself."""
    content = bytearray(path.read_bytes())
    for signature, shift in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        place = content.find(signature)
        while place >= 0:
            content[place + offset + shift] = value
            place = content.find(signature, place + 1)
    path.write_bytes(bytes(content))


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
    "encrypted": lambda path: _flag_members(path, 6, 1),
    "unknown compression": lambda path: _flag_members(path, 8, 99),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_episode_is_left_out_and_named(tmp_path, damage):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    add_episodes(replay, 3)
    save(checkpoints, 1, replay)
    DAMAGES[damage](tmp_path / "replay" / "episode_00000001.npz")

    said, restored = [], make_replay()
    checkpoints = Checkpoints(tmp_path, say=said.append)
    state, _ = checkpoints.restore(ABSTRACT, restored)

    assert_same_state(make_state(1), state)
    assert restored.episodes == [0, 2]
    for index in restored.episodes:
        for a, b in zip(restored.episode(index), replay.episode(index), strict=True):
            np.testing.assert_array_equal(a, b)
    assert len(said) == 1
    assert said[0].startswith("1 damaged episodes are left out of the replay (episode_")
    assert "episode_00000001.npz: " in said[0]

    # Resumed: its numbers go on, and later checkpoints have the gap without a word,
    # until the ring has moved past it.
    for frame in range(2, 6):
        add_episodes(restored, 1)
        save(checkpoints, frame, restored)
        again = make_replay()
        Checkpoints(tmp_path, say=said.append).restore(ABSTRACT, again)
        assert_same_replay(restored, again)
    assert again.episodes == [4, 5, 6]
    assert len(said) == 1
    assert not (tmp_path / "replay" / "episode_00000001.npz").exists()


def test_exchanged_episodes_are_noticed(tmp_path):
    replay = make_replay()
    add_episodes(replay, 3)
    save(Checkpoints(tmp_path), 1, replay)
    first, second = (
        tmp_path / "replay" / f"episode_{index:08d}.npz" for index in (0, 2)
    )
    first.rename(tmp_path / "aside")
    second.rename(first)
    (tmp_path / "aside").rename(second)

    said, restored = [], make_replay()
    Checkpoints(tmp_path, say=said.append).restore(ABSTRACT, restored)

    assert restored.episodes == [1]
    assert "episode_00000000.npz: has changed since it was written" in said[0]


def test_a_forged_episode_is_noticed_also_after_a_second_save(tmp_path):
    replay = make_replay()
    add_episodes(replay, 2)
    save(Checkpoints(tmp_path), 1, replay)
    again = make_replay()
    resumed = Checkpoints(tmp_path)
    resumed.restore(ABSTRACT, again)
    save(resumed, 2, again)
    path = tmp_path / "replay" / "episode_00000001.npz"
    arrays = dict(np.load(path))
    arrays["rewards"] += 1
    np.savez(path, **arrays)  # with right checksums of its own

    said, restored = [], make_replay()
    Checkpoints(tmp_path, say=said.append).restore(ABSTRACT, restored)

    assert restored.episodes == [0]
    assert "episode_00000001.npz: has changed since it was written" in said[0]


def test_without_any_episode_the_learner_is_resumed(tmp_path):
    replay = make_replay()
    add_episodes(replay, 5)
    save(Checkpoints(tmp_path), 1, replay)
    shutil.rmtree(tmp_path / "replay")

    said, restored = [], make_replay()
    checkpoints = Checkpoints(tmp_path, say=said.append)
    checkpoints.restore(ABSTRACT, restored)
    assert restored.episodes == []
    assert restored.num_episodes_added == 5
    add_episodes(restored, 1)
    save(checkpoints, 2, restored)
    again = make_replay()
    Checkpoints(tmp_path).restore(ABSTRACT, again)
    assert again.episodes == [5]
    assert len(said) == 1


def test_replaced_rewards_come_back(tmp_path):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    for num_steps in (4, 2, 3):
        add_episodes(replay, 1, num_steps)
    save(checkpoints, 1, replay)
    before = episode_files_of(tmp_path)
    for index in replay.episodes:
        replay.replace_rewards(index, -replay.rewards(index))
    save(checkpoints, 2, replay)

    assert episode_files_of(tmp_path) == before
    restored = make_replay()
    Checkpoints(tmp_path).restore(ABSTRACT, restored)
    assert_same_replay(replay, restored)

    # The others' also where one episode has been lost.
    (tmp_path / "replay" / "episode_00000001.npz").unlink()
    Checkpoints(tmp_path, say=lambda _: None).restore(ABSTRACT, restored)
    for index in (0, 2):
        np.testing.assert_array_equal(restored.rewards(index), replay.rewards(index))


@pytest.mark.parametrize("has_rewards", [False, True])
def test_a_checkpoint_of_an_earlier_version_is_restored(
    tmp_path, monkeypatch, has_rewards
):
    # Without rewards, at first; without a list of episodes and their checksums.
    replay, write = make_replay(), learner_files.write
    add_episodes(replay, 2)

    def write_as_before(folder, state, record, arrays):
        for name in ("episodes", "episode_steps", "episode_checksums"):
            del record[name]
        write(folder, state, record, arrays if has_rewards else {})

    monkeypatch.setattr(learner_files, "write", write_as_before)
    save(Checkpoints(tmp_path), 1, replay)
    for index in range(2):
        arrays: dict = replay.episode(index)._asdict()
        np.savez(tmp_path / "replay" / f"episode_{index:08d}.npz", **arrays)
        if has_rewards:
            arrays["rewards"] = arrays["rewards"] * 0
            np.savez(tmp_path / "replay" / f"episode_{index:08d}.npz", **arrays)

    restored = make_replay()
    Checkpoints(tmp_path).restore(ABSTRACT, restored)
    assert_same_replay(replay, restored)


def test_strays_are_ignored(tmp_path):
    replay = make_replay()
    add_episodes(replay, 2)
    save(Checkpoints(tmp_path), 1, replay)
    for folder in [path for path in tmp_path.rglob("*") if path.is_dir()]:
        (folder / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    (tmp_path / "checkpoints" / "frame_000000000009.bak").mkdir()

    said, restored = [], make_replay()
    checkpoints = Checkpoints(tmp_path, say=said.append)
    checkpoints.restore(ABSTRACT, restored)
    assert said == []
    assert_same_replay(replay, restored)
    save(checkpoints, 2, restored)
    save(checkpoints, 3, restored)


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
    said = []
    checkpoints = Checkpoints(tmp_path, say=said.append)
    state, _ = checkpoints.restore(ABSTRACT, replay)
    assert_same_state(make_state(1), state)
    assert len(said) == 1
    save(checkpoints, 3, replay)  # which removes it
    assert Checkpoints(tmp_path).newest() == 3
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["frame_000000000001", "frame_000000000003"]


@pytest.mark.parametrize("what", ["episode", "room", "learner", "folder"])
def test_a_full_disk_leaves_the_checkpoint_before(tmp_path, monkeypatch, what):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    add_episodes(replay, 1)
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
    again = make_replay()
    Checkpoints(tmp_path).restore(ABSTRACT, again)
    assert_same_replay(replay, again)


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


def test_the_learner_alone_can_be_restored(tmp_path):
    replay = make_replay()
    add_episodes(replay, 1)
    save(Checkpoints(tmp_path), 1, replay)
    (tmp_path / "replay" / "episode_00000000.npz").unlink()

    state, _ = Checkpoints(tmp_path).restore(ABSTRACT)

    assert_same_state(make_state(1), state)


def test_one_frame_can_be_saved_twice(tmp_path):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    save(checkpoints, 5, replay, note="first")
    save(checkpoints, 5, replay, note="second")

    _, counters = Checkpoints(tmp_path).restore(ABSTRACT)

    assert counters == {"note": "second"}
    assert Checkpoints(tmp_path).newest() == 5


def test_without_a_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path / "nothing")

    assert checkpoints.newest() is None
    with pytest.raises(CheckpointError, match="expected a checkpoint, found none"):
        checkpoints.restore(ABSTRACT)
    assert list(tmp_path.iterdir()) == []


def test_when_all_are_damaged(tmp_path):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    save(checkpoints, 1, replay)
    save(checkpoints, 2, replay)
    for name in ("frame_000000000001", "frame_000000000002"):
        flip_a_bit(tmp_path, name, 0)

    with pytest.raises(
        CheckpointError, match=r"frame 2 is damaged.*frame 1 is damaged"
    ):
        Checkpoints(tmp_path).restore(ABSTRACT, replay)


def test_a_checkpoint_of_another_learner_is_refused(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay())
    other = dict(
        ABSTRACT, actor=[{"kernel": jax.ShapeDtypeStruct((9, 5), jnp.float32)}, 1]
    )
    del other["flag"]

    with pytest.raises(CheckpointError) as caught:
        Checkpoints(tmp_path).restore(other)

    message = str(caught.value)
    assert "actor.0.kernel is float32[3, 5], expected float32[9, 5]" in message
    assert "actor.1 is missing" in message
    assert "flag is unknown" in message


def test_saving_over_a_run_that_was_not_restored_is_refused(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay())

    with pytest.raises(CheckpointError, match="holds a checkpoint of frame 1"):
        save(Checkpoints(tmp_path), 2, make_replay())


ROOT = pathlib.Path(__file__).parents[2]
SAVE_FOREVER = """
import itertools, sys
from tests.training import test_checkpoint as t
checkpoints, replay = t.Checkpoints(sys.argv[1]), t.make_replay()
first = 1
if checkpoints.newest() is not None:
    first = checkpoints.restore(t.ABSTRACT, replay)[1]["episodes"] + 1
for frame in itertools.count(first):
    t.add_episodes(replay, 1)
    t.save(checkpoints, frame, replay, episodes=frame)
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
        saved = int(lines[-1])

        restored, expected = make_replay(), make_replay()
        state, counters = Checkpoints(tmp_path).restore(ABSTRACT, restored)

        assert counters["episodes"] >= saved
        assert_same_state(make_state(counters["episodes"]), state)
        add_episodes(expected, counters["episodes"])
        assert_same_replay(expected, restored)
