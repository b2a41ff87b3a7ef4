"""Demonstration files that break the rules, are damaged or not what was asked for."""

import json
import zipfile
from typing import Any

import numpy as np
import pytest

from jaxil.demonstrations import loading, states
from jaxil.demonstrations.states import DemonstrationError
from jaxil.files import archive
from tests.demonstrations.recorded_states import (
    RECORDED,
    TASK,
    assert_same,
    load,
    write_recorded,
)
from tests.files.damaged_archives import replace_member


@pytest.fixture(name="path")
def _path(tmp_path):
    return write_recorded(tmp_path)


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


def test_images_that_would_take_too_much_memory_are_refused_before_they_are_rendered(
    path,
):
    wanted = {"task": TASK, "num_episodes": 2, "action_repeat": 2, "image_size": 16}
    needed = 2 * 5 * 16**2 * 3
    loading.check(path, **wanted, max_bytes=needed)
    for call in (load, loading.check):
        with pytest.raises(DemonstrationError, match=f"needs {needed} bytes at 16x16"):
            call(path, **wanted, max_bytes=needed - 1)


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
    "beyond numbers": (lambda a: set_metadata(a, action_repeat=10**400), "not in"),
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
    assert "jaxil collect" in text


@pytest.mark.parametrize(
    "field", ["format", "version", "task", "seed", "returns", "versions"]
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
        qpos = whole.read("qpos.npy")
    # 2 episodes become 2 000 000 000; the blanks that pad the header make room for it.
    qpos = qpos.replace(b"(2, 5,", b"(2000000000, 5,").replace(b" " * 9, b"", 1)
    replace_member(path, "qpos.npy", qpos)
    message = "qpos whose header claims a wrong length"
    with pytest.raises(DemonstrationError, match=message):
        states.read_states(path)


def test_the_writer_keeps_the_rules_and_the_old_file(path):
    broken = RECORDED._replace(rewards=np.full_like(RECORDED.rewards, np.inf))
    with pytest.raises(DemonstrationError, match="rewards"):
        states.write_states(path, broken)
    assert_same(states.read_states(path), RECORDED)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
