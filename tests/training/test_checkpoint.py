"""Checkpoints: round trips, increments, kills in mid-save, damage."""

import pathlib
import random
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint
import pytest

from jaxil.replay.replay import Replay
from jaxil.training.checkpoint import CheckpointError, Checkpoints


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
    assert other.check_valid() == (True, "")
    assert one.oldest_episode == other.oldest_episode
    assert one.num_episodes_added == other.num_episodes_added
    for index in range(one.oldest_episode, one.num_episodes_added):
        for a, b in zip(one.episode(index), other.episode(index), strict=True):
            np.testing.assert_array_equal(a, b)


def episode_files(workdir) -> dict:
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
    before = episode_files(tmp_path)
    add_episodes(replay, 2)  # 0 is evicted: three fit
    save(checkpoints, 2, replay)
    after = episode_files(tmp_path)

    assert len(before) == 2
    assert set(after) == {f"episode_{i:08d}.npz" for i in range(4)}
    assert {name: after[name] for name in before} == before

    add_episodes(replay, 1)
    save(checkpoints, 3, replay)

    # Kept are the checkpoints 2 (episodes 1 to 3) and 3 (2 to 4).
    assert set(episode_files(tmp_path)) == {f"episode_{i:08d}.npz" for i in range(1, 5)}
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["frame_000000000002", "frame_000000000003"]


def test_a_resumed_run_goes_on_where_the_files_end(tmp_path):
    replay = make_replay()
    add_episodes(replay, 3)
    save(Checkpoints(tmp_path), 1, replay)
    before = episode_files(tmp_path)

    checkpoints, resumed = Checkpoints(tmp_path), make_replay()
    checkpoints.restore(ABSTRACT, resumed)
    add_episodes(resumed, 2)
    save(checkpoints, 2, resumed)
    add_episodes(replay, 2)

    after = episode_files(tmp_path)
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
                if "episode_00000005.npz" in episode_files(tmp_path):
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
                "jaxil.training.checkpoint.os.replace",
                lambda old, new: kill() if "frame_" in str(new) else old.rename(new),
            )
        else:
            patched.setattr("jaxil.training.checkpoint.shutil.rmtree", kill)
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

    # The resumed run writes episode 5 anew, leftovers go, and all is whole again.
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
    assert said[0].endswith(": going on from frame 1")
    assert "\n" not in said[0]

    # Going on: another episode 4 than the damaged checkpoint knew, and another frame 2.
    add_episodes(restored, 1, num_steps=3)
    save(survivor, 2, restored)
    again = make_replay()
    Checkpoints(tmp_path, say=said.append).restore(ABSTRACT, again)
    assert_same_replay(restored, again)
    assert len(said) == 1


@pytest.mark.parametrize("damage", ["missing", "cut off", "other shape"])
def test_a_damaged_episode_falls_back(tmp_path, damage):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    add_episodes(replay, 2)
    save(checkpoints, 1, replay)
    add_episodes(replay, 1)
    save(checkpoints, 2, replay)
    path = tmp_path / "replay" / "episode_00000002.npz"
    if damage == "missing":
        path.unlink()
    elif damage == "cut off":
        path.write_bytes(path.read_bytes()[:-100])
    else:
        np.savez(path, frames=1, actions=1, rewards=1, discounts=1)

    said, restored = [], make_replay()
    Checkpoints(tmp_path, say=said.append).restore(ABSTRACT, restored)

    assert restored.num_episodes_added == 2
    assert "episode_00000002.npz" in said[0]


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
