"""Demonstration files: round trips, the agent's own pixels, cache, shipped files."""

import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.demonstrations import loading, rendering, sampling, states
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments.tasks import make_environment
from tests.demonstrations.recorded_states import (
    FIRST_EPISODE,
    FRAMES,
    NUM_EPISODES,
    NUM_STEPS,
    RECORDED,
    SEED,
    SIZE,
    TASK,
    VIEW,
    assert_same,
    load,
    play,
    write_recorded,
)


@pytest.fixture(name="path")
def _path(tmp_path):
    return write_recorded(tmp_path)


# --- what is read back ----------------------------------------------------------------


def test_what_is_written_is_read(path):
    assert_same(states.read_states(path), RECORDED)
    first = states.read_states(path, task=TASK, num_episodes=1)
    assert len(first.qpos) == len(first.rewards) == len(first.metadata["returns"]) == 1
    np.testing.assert_array_equal(first.qvel[0], RECORDED.qvel[0])


def test_frames_are_those_that_the_agent_saw(path):
    loaded = load(path)
    np.testing.assert_array_equal(loaded.frames, FRAMES)
    np.testing.assert_array_equal(loaded.actions, RECORDED.actions)
    np.testing.assert_array_equal(loaded.task_rewards, RECORDED.rewards)
    assert len(np.unique(FRAMES.reshape(-1, SIZE * SIZE * 3), axis=0)) > NUM_STEPS


def test_a_multiple_of_the_action_repeat_skips_states_and_sums_rewards(path):
    loaded = load(path, action_repeat=4)
    np.testing.assert_array_equal(loaded.frames, FRAMES[:, ::2])
    np.testing.assert_array_equal(loaded.actions, RECORDED.actions[:, ::2])
    assert loaded.task_rewards is not None
    pairs = RECORDED.rewards[:, 0::2] + RECORDED.rewards[:, 1::2]
    np.testing.assert_allclose(loaded.task_rewards, pairs)
    assert loaded.metadata["action_repeat"] == 4

    # Three of the four steps fill one of the agent's; the fourth is left over.
    loaded = load(path, action_repeat=6)
    np.testing.assert_array_equal(loaded.frames, FRAMES[:, [0, 3]])
    assert loaded.actions is not None
    assert loaded.actions.shape == (NUM_EPISODES, 1, 2)


def test_states_are_served_as_the_suite_observes_them(path):
    loaded = load(path, observation="state")
    environment = make_environment(TASK, seed=SEED, observation="state")
    for index in range(NUM_EPISODES):
        start = environment.reset(episode=FIRST_EPISODE + index).observation
        np.testing.assert_allclose(loaded.frames[index, 0], start, atol=1e-6)
    assert loaded.frames.dtype == np.float32


@settings(deadline=None, max_examples=30)
@given(batch_size=st.integers(1, 20), frame_stack=st.integers(1, 4))
def test_samples_are_stacks_of_one_episode_with_their_actions(batch_size, frame_stack):
    # Frame t of episode k holds 10 k + t, and so does action t.
    times = 10 * np.arange(2)[:, None] + np.arange(6)
    frames = np.broadcast_to(times[..., None, None, None], (2, 6, 2, 2, 3))
    actions = times[:, :5, None].astype(np.float32)
    loaded = loading.Demonstrations(
        frames.astype(np.uint8), np.array([6, 6]), actions, actions[..., 0], {}
    )
    observation, action, successor = sampling.sample(
        loaded,
        np.random.default_rng(batch_size),
        batch_size,
        frame_stack=frame_stack,
        successors=True,
    )
    assert successor is not None
    assert successor.shape == observation.shape
    plain = sampling.sample(
        loaded, np.random.default_rng(batch_size), batch_size, frame_stack=frame_stack
    )
    assert plain.successor is None
    np.testing.assert_array_equal(plain.observation, observation)
    assert observation.shape == (batch_size, 2, 2, 3 * frame_stack)
    newest = action[:, 0]
    for age in range(frame_stack):
        expected = np.maximum(newest - age, newest // 10 * 10)
        channel = observation[..., 3 * (frame_stack - 1 - age)]
        np.testing.assert_array_equal(channel[:, 0, 0], expected)
        expected = np.maximum(newest + 1 - age, newest // 10 * 10)
        channel = successor[..., 3 * (frame_stack - 1 - age)]
        np.testing.assert_array_equal(channel[:, 0, 0], expected)


# --- cache ----------------------------------------------------------------------------


def num_rendered(path, **changes) -> int:
    calls = []
    load(path, progress=lambda *call: calls.append(call), **changes)
    return len(calls)


def test_images_are_rendered_once_for_each_view(path, monkeypatch):
    whole = NUM_EPISODES * (NUM_STEPS + 1)
    assert num_rendered(path, num_episodes=1) == whole / 2
    assert num_rendered(path) == whole / 2, "the first episode was there already"
    assert num_rendered(path) == 0
    assert num_rendered(path, image_size=SIZE + 1) == whole
    assert num_rendered(path, render_quality="paper") == whole
    assert num_rendered(path, action_repeat=4) == NUM_EPISODES * 3
    assert num_rendered(path, cache=False) == whole
    versions = {"mujoco": "0", "dm_control": "0"}
    monkeypatch.setattr(rendering.suite, "simulator_versions", lambda: versions)
    assert num_rendered(path) == whole, "another simulator renders other pixels"
    np.testing.assert_array_equal(load(path).frames, FRAMES)


def flip_a_byte(entry):
    content = bytearray(entry.read_bytes())
    content[len(content) // 2] ^= 1  # amid the pixels
    entry.write_bytes(bytes(content))


def become_another_file(entry):
    with entry.open("wb") as file:
        np.save(file, np.zeros(3))


@pytest.mark.parametrize(
    "damage",
    [
        lambda entry: entry.write_bytes(entry.read_bytes()[:-10]),
        lambda entry: entry.write_bytes(b""),
        flip_a_byte,
        lambda entry: np.savez(entry, images=np.zeros(3, np.uint8)),
        lambda entry: np.savez(entry, x=np.zeros(3)),
        become_another_file,
    ],
    ids=["cut", "empty", "flipped byte", "other shape", "no array", "other file"],
)
def test_damaged_cache_entries_are_rendered_again(path, tmp_path, damage):
    load(path)
    entry = min((tmp_path / "cache" / "frames").glob("*.npz"))
    damage(entry)
    np.testing.assert_array_equal(load(path).frames, FRAMES)
    assert num_rendered(path) == 0
    assert not list(entry.parent.glob("*.part"))


def test_a_cache_that_cannot_be_written_is_done_without(path, monkeypatch, caplog):
    monkeypatch.setenv("JAXIL_CACHE", str(path))  # a file, not a folder
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(load(path).frames, FRAMES)
    assert "JAXIL_CACHE" in caplog.text


def test_other_versions_are_warned_of(path, caplog):
    old = {"mujoco": "3.0.0", "dm_control": "1.0.14", "jaxil": "0.1.0"}
    states.write_states(
        path, RECORDED._replace(metadata={**RECORDED.metadata, "versions": old})
    )
    with caplog.at_level(logging.WARNING):
        load(path)
    assert "mujoco 3.0.0" in caplog.text


# --- shipped --------------------------------------------------------------------------


def test_shipped_files_are_found_by_task(path, tmp_path, monkeypatch):
    folder = tmp_path / "shipped"
    folder.mkdir()
    path.rename(folder / f"{TASK}.npz")
    monkeypatch.setattr(states, "_shipped_folder", lambda: folder)
    assert states.shipped_tasks() == (TASK,)
    np.testing.assert_array_equal(load("").frames, FRAMES)
    with pytest.raises(DemonstrationError, match=f"walker_walk.*only of: {TASK}"):
        states.shipped_path("walker_walk")


# What imitators are promised; the paper's experts are the best of ten pixel seeds.
LEAST_MEAN_RETURNS = {
    "acrobot_swingup": 400,
    "ball_in_cup_catch": 960,
    "cartpole_swingup": 850,
    "cheetah_run": 850,
    "finger_spin": 950,
    "walker_run": 720,
    "walker_stand": 970,
    "walker_walk": 950,
}


def test_the_shipped_experts_are_good_and_small():
    paths = {task: states.shipped_path(task) for task in LEAST_MEAN_RETURNS}
    assert set(states.shipped_tasks()) == set(paths)
    assert sum(path.stat().st_size for path in paths.values()) < 25e6
    for task, path in paths.items():
        loading.check("", task=task, num_episodes=10, action_repeat=2)
        rewards = states.read_states(path, task=task).rewards
        assert len(rewards) == 50
        assert rewards.sum(axis=1).mean() >= LEAST_MEAN_RETURNS[task], task


@pytest.mark.parametrize("task", states.shipped_tasks())
def test_shipped_actions_played_again_lead_to_the_stored_states(task):
    # An episode's beginning: the whole of it would also agree where it was recorded,
    # but another processor may round differently, and contacts amplify that.
    num_steps = 25
    stored = states.read_states(states.shipped_path(task), task=task)
    episode = len(stored.rewards) - 1
    metadata = stored.metadata
    seed, action_repeat = metadata["seed"], metadata["action_repeat"]
    environment = make_environment(task, seed=seed, action_repeat=action_repeat, **VIEW)
    number = metadata["first_episode"] + episode
    actions = stored.actions[episode, :num_steps]
    visited, frames, rewards = play(environment, number, actions)
    environment.close()
    np.testing.assert_allclose(rewards, stored.rewards[episode, :num_steps], atol=1e-4)
    stored_states = {
        name: getattr(stored, name)[episode : episode + 1, : num_steps + 1]
        for name in visited
    }
    for name, values in stored_states.items():
        np.testing.assert_allclose(visited[name], values[0], atol=1e-4, rtol=1e-4)
    rendered = rendering.observe_episodes(
        stored_states, task=task, seed=seed, first_episode=number, cache=False, **VIEW
    )
    assert (rendered[0] != frames).mean() < 1e-3
    assert rendered.std() > 1.0
