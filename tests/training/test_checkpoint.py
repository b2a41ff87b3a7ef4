"""Checkpoints: what is saved, restored and refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.training.checkpoint import CheckpointError, Checkpoints
from tests.training.saved_runs import (
    ABSTRACT,
    add_episodes,
    assert_same_replay,
    assert_same_state,
    make_replay,
    make_state,
    restore,
    save,
)


def episode_files_of(workdir) -> dict:
    """Names of the episode files, with what tells whether one was written again."""
    stats = {path.name: path.stat() for path in (workdir / "replay").iterdir()}
    return {name: (stat.st_ino, stat.st_mtime_ns) for name, stat in stats.items()}


def test_everything_comes_back(tmp_path):
    replay = make_replay(5)
    generator = np.random.default_rng(3)
    generator.normal(size=7)
    state = generator.bit_generator.state
    counters = {"frame": 10, "seconds": 1 / 3, "generator": state}
    Checkpoints(tmp_path).save(
        frame=10, learner_state=make_state(3), counters=counters, replay=replay
    )
    restored = restore(tmp_path)
    assert restored.checkpoints.newest() == 10
    assert_same_state(make_state(3), restored.state)
    assert restored.counters == counters
    assert_same_replay(replay, restored.replay)
    replays = (replay, restored.replay)
    draws = [each.sample(np.random.default_rng(0), 16) for each in replays]
    for a, b in zip(*draws, strict=True):
        np.testing.assert_array_equal(a, b)


def test_restored_arrays_can_be_donated(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay())
    half = restore(tmp_path).state["half"]
    double = jax.jit(lambda x: x * 2, donate_argnums=0)
    np.testing.assert_array_equal(double(double(half)), [6, 6])


def test_episodes_are_written_once_and_go_after_the_checkpoints_that_need_them(
    tmp_path,
):
    checkpoints, replay = Checkpoints(tmp_path), make_replay(2)
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
    save(Checkpoints(tmp_path), 1, make_replay(3))
    before = episode_files_of(tmp_path)
    resumed = restore(tmp_path)
    add_episodes(resumed.replay, 2)
    save(resumed.checkpoints, 2, resumed.replay)
    after = episode_files_of(tmp_path)
    assert {name: after[name] for name in before} == before
    assert_same_replay(make_replay(5), restore(tmp_path).replay)


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
    assert_same_replay(replay, restore(tmp_path).replay)
    # The others' also where one episode has been lost.
    (tmp_path / "replay" / "episode_00000001.npz").unlink()
    restored = restore(tmp_path).replay
    for index in (0, 2):
        np.testing.assert_array_equal(restored.rewards(index), replay.rewards(index))


def test_other_files_in_the_folders_are_ignored(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay(2))
    for folder in [path for path in tmp_path.rglob("*") if path.is_dir()]:
        (folder / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    (tmp_path / "checkpoints" / "frame_000000000009.bak").mkdir()
    checkpoints, restored, _, _, said = restore(tmp_path)
    assert said == []
    assert_same_replay(make_replay(2), restored)
    save(checkpoints, 2, restored)
    save(checkpoints, 3, restored)


def test_one_frame_can_be_saved_twice(tmp_path):
    checkpoints, replay = Checkpoints(tmp_path), make_replay()
    save(checkpoints, 5, replay, note="first")
    save(checkpoints, 5, replay, note="second")
    assert restore(tmp_path).counters == {"note": "second"}
    assert Checkpoints(tmp_path).newest() == 5


def test_without_a_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path / "nothing")
    assert checkpoints.newest() is None
    with pytest.raises(CheckpointError, match="expected a checkpoint, found none"):
        checkpoints.restore(ABSTRACT, make_replay())
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_of_another_learner_is_refused(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay())
    other = dict(
        ABSTRACT, actor=[{"kernel": jax.ShapeDtypeStruct((9, 5), jnp.float32)}, 1]
    )
    del other["flag"]
    with pytest.raises(CheckpointError) as caught:
        Checkpoints(tmp_path).restore(other, make_replay())
    message = str(caught.value)
    assert "actor.0.kernel is float32[3, 5], expected float32[9, 5]" in message
    assert "actor.1 is missing" in message
    assert "flag is unknown" in message


def test_saving_over_a_run_that_was_not_restored_is_refused(tmp_path):
    save(Checkpoints(tmp_path), 1, make_replay())
    with pytest.raises(CheckpointError, match="holds a checkpoint of frame 1"):
        save(Checkpoints(tmp_path), 2, make_replay())
