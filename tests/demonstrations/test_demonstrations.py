"""Demonstration files: round trips, the agent's own pixels, all kinds of damage."""

import json
import logging
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.demonstrations import loading, rendering, sampling, states
from jaxil.demonstrations.states import DemonstrationError, StateDemonstrations
from jaxil.environments.suite import make_environment
from jaxil.files import archive

TASK = "finger_turn_hard"  # its target is not part of the simulator's state
NUM_EPISODES, NUM_STEPS, SIZE = 2, 4, 16
SEED, FIRST_EPISODE = 5, 3
VIEW = {"image_size": SIZE, "render_quality": "fast"}


def record(action_repeat=2, num_steps=NUM_STEPS):
    """Plays at random; returns the states to store and the frames that were seen."""
    environment = make_environment(
        TASK, seed=SEED, action_repeat=action_repeat, frame_stack=1, **VIEW
    )
    rng = np.random.default_rng(0)
    stored: dict[str, list] = {
        name: [] for name in ("qpos", "qvel", "act", "actions", "rewards", "frames")
    }
    for index in range(NUM_EPISODES):
        environment.reset(episode=FIRST_EPISODE + index)
        visited = [environment.simulator_state()]
        frames = [environment.frame()]
        actions = rng.uniform(-1, 1, (num_steps, 2)).astype(np.float32)
        rewards = []
        for action in actions:
            rewards.append(environment.step(action).reward)
            visited.append(environment.simulator_state())
            frames.append(environment.frame())
        for name in ("qpos", "qvel", "act"):
            stored[name].append(np.stack([state[name] for state in visited]))
        stored["actions"].append(actions)
        stored["rewards"].append(np.array(rewards, np.float32))
        stored["frames"].append(np.stack(frames))
    environment.close()
    arrays = {name: np.stack(values) for name, values in stored.items()}
    frames = arrays.pop("frames")
    metadata = states.new_metadata(
        task=TASK,
        action_repeat=action_repeat,
        seed=SEED,
        first_episode=FIRST_EPISODE,
        expert="uniform actions",
        rewards=arrays["rewards"],
    )
    return StateDemonstrations(**arrays, metadata=metadata), frames


RECORDED, FRAMES = record()


@pytest.fixture(name="path")
def _path(tmp_path):
    path = tmp_path / "demonstrations.npz"
    states.write_states(path, RECORDED)
    return path


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXIL_CACHE", str(tmp_path / "cache"))


def load(path, **changes):
    arguments = {"task": TASK, "num_episodes": NUM_EPISODES, "action_repeat": 2, **VIEW}
    return loading.load(path, **(arguments | changes))


def assert_same(first: StateDemonstrations, second: StateDemonstrations):
    assert first.metadata == second.metadata
    for one, other in zip(first[:-1], second[:-1], strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


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


def drawn_images(path, **changes) -> int:
    drawn = []
    load(path, progress=lambda done, total: drawn.append((done, total)), **changes)
    return len(drawn)


def test_images_are_drawn_once_for_each_view(path, monkeypatch):
    whole = NUM_EPISODES * (NUM_STEPS + 1)
    assert drawn_images(path, num_episodes=1) == whole / 2
    assert drawn_images(path) == whole / 2, "the first episode was there already"
    assert drawn_images(path) == 0
    assert drawn_images(path, image_size=SIZE + 1) == whole
    assert drawn_images(path, render_quality="paper") == whole
    assert drawn_images(path, action_repeat=4) == NUM_EPISODES * 3
    assert drawn_images(path, cache=False) == whole
    versions = {"mujoco": "0", "dm_control": "0"}
    monkeypatch.setattr(rendering.suite, "simulator_versions", lambda: versions)
    assert drawn_images(path) == whole, "another simulator draws other pixels"
    np.testing.assert_array_equal(load(path).frames, FRAMES)


@pytest.mark.parametrize(
    "damage", ["cut", "empty", "flipped byte", "other shape", "no array", "other file"]
)
def test_damaged_cache_entries_are_rendered_again(path, tmp_path, damage):
    load(path)
    entry = min((tmp_path / "cache" / "frames").glob("*.npz"))
    if damage == "cut":
        entry.write_bytes(entry.read_bytes()[:-10])
    elif damage == "empty":
        entry.write_bytes(b"")
    elif damage == "flipped byte":
        content = bytearray(entry.read_bytes())
        content[len(content) // 2] ^= 1  # amid the pixels
        entry.write_bytes(bytes(content))
    elif damage == "other shape":
        np.savez(entry, images=np.zeros(3, np.uint8))
    elif damage == "no array":
        np.savez(entry, x=np.zeros(3))
    else:
        with entry.open("wb") as file:
            np.save(file, np.zeros(3))
    np.testing.assert_array_equal(load(path).frames, FRAMES)
    assert drawn_images(path) == 0
    assert not list(entry.parent.glob("*.part"))


def test_a_cache_that_cannot_be_written_is_done_without(path, monkeypatch, caplog):
    monkeypatch.setenv("JAXIL_CACHE", str(path))  # a file, not a folder
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(load(path).frames, FRAMES)
    assert "JAXIL_CACHE" in caplog.text


def test_other_versions_are_said(path, caplog):
    old = {"mujoco": "3.0.0", "dm_control": "1.0.14", "jaxil": "0.1.0"}
    states.write_states(
        path, RECORDED._replace(metadata={**RECORDED.metadata, "versions": old})
    )
    with caplog.at_level(logging.WARNING):
        load(path)
    assert "mujoco 3.0.0" in caplog.text


# --- faults ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"task": "walker_walk"},
            "shows finger_turn_hard, but the task is walker_walk",
        ),
        ({"num_episodes": 3}, "holds 2 episodes, but num_episodes=3. Use 1 to 2"),
        ({"num_episodes": 0}, "but num_episodes=0. Use 1 to 2"),
        ({"action_repeat": 3}, "recorded with action_repeat=2, not 3"),
        ({"action_repeat": 1}, "Use a multiple of 2"),
        ({"action_repeat": 10}, "shorter than one step of action_repeat=10"),
    ],
)
def test_a_file_that_is_not_what_was_asked_for(path, changes, message):
    arguments = {"task": TASK, "num_episodes": 2, "action_repeat": 2} | changes
    for call in (load, loading.check):
        with pytest.raises(DemonstrationError, match=message) as caught:
            call(path, **arguments)
        assert str(path) in str(caught.value)


def tampered(path, change):
    """Rewrites the file at `path` with `change` applied to its dict of arrays."""
    with np.load(path) as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(path, allow_pickle=True, **arrays)


def set_metadata(arrays, **changes):
    metadata = json.loads(str(arrays["metadata"]))
    arrays["metadata"] = np.array(json.dumps({**metadata, **changes}))


def set_nan(arrays):
    arrays["qvel"][1, 2, 0] = np.nan


TAMPERINGS = {
    "missing array": (lambda a: a.pop("act"), "has no array act"),
    "missing metadata": (lambda a: a.pop("metadata"), "has no array metadata"),
    "nan": (set_nan, "NaN or infinity in qvel, episode 1"),
    "wrong type": (
        lambda a: a.update(qpos=a["qpos"].astype(np.float32)),
        "qpos of type float32, but float64 is expected",
    ),
    "a state too few": (
        lambda a: a.update(qpos=a["qpos"][:, :-1]),
        r"qpos of shape \(2, 4, 3\) for rewards of \(2, 4\)",
    ),
    "an episode too few": (lambda a: a.update(actions=a["actions"][:1]), "actions of"),
    "no episodes": (
        lambda a: a.update({n: x[:0] for n, x in a.items() if n != "metadata"}),
        r"rewards of shape \(0, 4\)",
    ),
    "another model": (
        lambda a: a.update(qpos=a["qpos"][..., :-1]),
        "qpos of 2 numbers, but finger_turn_hard needs 3",
    ),
    "actions of another model": (
        lambda a: a.update(actions=a["actions"][..., :-1]),
        "actions of 1 numbers, but finger_turn_hard needs 2",
    ),
    "pickled": (
        lambda a: a.update(actions=np.array([{"a": 1}], dtype=object)),
        "Python objects",
    ),
    "not json": (lambda a: a.update(metadata=np.array("{")), "not JSON"),
    "deep json": (lambda a: a.update(metadata=np.array("[" * 99_999)), "not JSON"),
    "a list": (lambda a: a.update(metadata=np.array("[]")), "not a file of demonstr"),
    "another format": (lambda a: set_metadata(a, format="x"), "not a file of demonstr"),
    "a later version": (
        lambda a: set_metadata(a, version=2),
        "version 2 of the format",
    ),
    "no task": (lambda a: set_metadata(a, task=None), "task=None, but str"),
    "boolean": (lambda a: set_metadata(a, seed=True), "seed=True, but int"),
    "negative": (lambda a: set_metadata(a, first_episode=-1), "first_episode=-1"),
    "few returns": (lambda a: set_metadata(a, returns=[1.0]), "but 2 are expected"),
    "no return": (lambda a: set_metadata(a, returns=[1.0, None]), "but 2 are expected"),
}


@pytest.mark.parametrize("name", TAMPERINGS)
def test_files_that_break_the_rules_are_refused(path, name):
    change, message = TAMPERINGS[name]
    tampered(path, change)
    with pytest.raises(DemonstrationError, match=message) as caught:
        loading.check(path, task=TASK, num_episodes=2, action_repeat=2)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert text.count("\n") == 0
    assert "jaxil.collect" in text


@pytest.mark.parametrize(
    "field", ["format", "version", "task", "camera", "seed", "returns", "versions"]
)
def test_text_of_a_file_is_made_harmless(path, field):
    hostile: Any = "\x1b]0;owned\a\u202e\n" * 10_000
    if field in ("returns", "versions"):
        hostile = [hostile]
    tampered(path, lambda arrays: set_metadata(arrays, **{field: hostile}))
    with pytest.raises(DemonstrationError) as caught:
        states.read_states(path, task=TASK)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 2500


def test_a_file_cut_off_anywhere_is_refused(path):
    content = path.read_bytes()
    for length in range(0, len(content), 97):
        path.write_bytes(content[:length])
        with pytest.raises(DemonstrationError, match="cut off"):
            states.read_states(path)


@pytest.mark.parametrize("folder", [True, False])
def test_a_file_that_cannot_be_opened(tmp_path, folder):
    path = tmp_path if folder else tmp_path / "none.npz"
    with pytest.raises(DemonstrationError, match="cannot be read"):
        states.read_states(path)


def test_arrays_that_would_fill_the_memory_are_not_unpacked(path, monkeypatch):
    monkeypatch.setattr(archive, "MAX_BYTES", 300)
    with pytest.raises(DemonstrationError, match=r"qpos of .* more than the 300"):
        states.read_states(path)
    # Each by itself is within the limit.
    monkeypatch.setattr(archive, "MAX_BYTES", 1000)
    monkeypatch.setattr(states, "_MAX_METADATA_BYTES", 1000)
    tampered(path, lambda arrays: set_metadata(arrays, expert="", versions={}))
    with pytest.raises(DemonstrationError, match=r"in all .* more than the 1000"):
        states.read_states(path)


def test_a_header_that_promises_more_than_there_is(path):
    with zipfile.ZipFile(path) as whole:
        members = {name: whole.read(name) for name in whole.namelist()}
    # 2 episodes become 2 000 000 000; the blanks that pad the header make room for it.
    members["qpos.npy"] = (
        members["qpos.npy"]
        .replace(b"(2, 5,", b"(2000000000, 5,")
        .replace(b" " * 9, b"", 1)
    )
    with zipfile.ZipFile(path, "w") as changed:
        for name, content in members.items():
            changed.writestr(name, content)
    with pytest.raises(
        DemonstrationError, match="qpos whose header claims a wrong length"
    ):
        states.read_states(path)


def test_the_writer_keeps_the_rules_and_the_old_file(path):
    broken = RECORDED._replace(rewards=np.full_like(RECORDED.rewards, np.inf))
    with pytest.raises(DemonstrationError, match="rewards"):
        states.write_states(path, broken)
    assert_same(states.read_states(path), RECORDED)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


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
    environment = make_environment(
        task,
        seed=metadata["seed"],
        action_repeat=metadata["action_repeat"],
        frame_stack=1,
        **VIEW,
    )
    number = metadata["first_episode"] + episode
    environment.reset(episode=number)
    frames, rewards, visited = [], [], []
    for action in stored.actions[episode, :num_steps]:
        visited.append(environment.simulator_state())
        frames.append(environment.frame())
        rewards.append(environment.step(action).reward)
    environment.close()
    np.testing.assert_allclose(rewards, stored.rewards[episode, :num_steps], atol=1e-4)
    moments = {
        name: getattr(stored, name)[episode : episode + 1, :num_steps]
        for name in ("qpos", "qvel", "act")
    }
    for name, values in moments.items():
        lived = np.stack([state[name] for state in visited])
        np.testing.assert_allclose(lived, values[0], atol=1e-4, rtol=1e-4)
    drawn = rendering.observe_episodes(
        moments,
        task=task,
        seed=metadata["seed"],
        first_episode=number,
        cache=False,
        **VIEW,
    )
    assert (drawn[0] != np.stack(frames)).mean() < 1e-3
    assert drawn.std() > 1.0
