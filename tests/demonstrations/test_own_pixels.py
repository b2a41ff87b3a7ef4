"""jaxil's own files of pixels: round trips, the rules of an episode, hostile text."""

import numpy as np
import pytest

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import own
from jaxil.demonstrations.readers.recording import (
    FormatError,
    Recording,
    checked_episode,
)
from jaxil.demonstrations.states import DemonstrationError
from jaxil.files import archive
from tests.demonstrations.pixel_files import (
    LIMIT,
    TASK,
    load,
    make_episode,
    set_metadata,
    write,
)


@pytest.fixture(name="path")
def _path(tmp_path):
    return tmp_path / "pixels.npz"


def test_what_is_written_is_read(path):
    episodes = [make_episode(4), make_episode(6, seed=1)._replace(rewards=None)]
    write(path, episodes, task=TASK, action_repeat=2, frames_per_second=50.0)
    recording = foreign.open_recording(path, max_bytes=LIMIT)
    assert recording.kind == "jaxil pixels"
    assert (recording.task, recording.action_repeat) == (TASK, 2)
    assert recording.frames_per_second == 50.0
    assert recording.origin == "a test"
    read = list(recording.episodes)
    assert len(read) == recording.num_episodes == 2
    for one, other in zip(read, episodes, strict=True):
        for got, expected in zip(one[:3], other[:3], strict=True):
            assert (got is None) == (expected is None)
            if expected is not None:
                np.testing.assert_array_equal(got, expected)


def test_a_broken_recording_leaves_the_old_file(path):
    write(path, [make_episode()])
    before = path.read_bytes()

    def episodes():
        yield make_episode()
        raise FormatError("is cut off")

    with pytest.raises(FormatError):
        own.write_pixels(path, Recording("x", 2, episodes()), origin="x")
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "x"}, "lack the format name"),
        ({"version": 2}, "version 2 of the format"),
        ({"action_repeat": "2"}, "action_repeat='2', not int"),
        ({"action_repeat": -1}, "action_repeat=-1, not in"),
        ({"action_repeat": 10**400}, "action_repeat=1000"),
        ({"frames_per_second": 0.0}, "frames_per_second=0.0"),
        ({"frames_per_second": 1e-300}, "frames_per_second=1e-300, not in"),
        ({"frames_per_second": float("nan")}, "frames_per_second=nan, not in"),
        ({"frames_per_second": float("inf")}, "frames_per_second=inf, not in"),
        ({"task": 1}, "task=1, not str"),
        ({"origin": None}, "without origin"),
    ],
)
def test_metadata_that_break_the_rules(path, changes, message):
    write(path, [make_episode(), make_episode(seed=1)])
    set_metadata(path, **changes)
    with pytest.raises(FormatError, match=message):
        list(foreign.open_recording(path, max_bytes=LIMIT).episodes)


def test_an_array_above_the_limit_is_not_unpacked(path):
    write(path, [make_episode()])
    with pytest.raises(FormatError, match="frames_0 of 1472 bytes, more than the 1000"):
        list(foreign.open_recording(path, max_bytes=1000).episodes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e._replace(frames=e.frames[..., :1]), "uint8"),
        (lambda e: e._replace(frames=e.frames.astype(np.float32)), "float32"),
        (lambda e: e._replace(frames=e.frames[:1]), "1 frames"),
        (lambda e: e._replace(frames=e.frames[:, :0]), "8x0 pixels"),
        (lambda e: e._replace(actions=e.actions[:-1]), "actions of type"),
        (lambda e: e._replace(actions=e.actions[:, 0]), "actions of type"),
        (lambda e: e._replace(rewards=e.rewards[:, None, None]), "rewards of type"),
        (lambda e: e._replace(rewards=e.rewards * np.float32("nan")), "not finite"),
        (lambda e: e._replace(actions=e.actions + np.float64(1e300)), "not finite"),
        (lambda e: e._replace(actions=e.actions + 0j), "actions of type complex"),
    ],
)
def test_episodes_that_break_the_rules_are_refused(change, message):
    assert checked_episode(3, make_episode()).rewards is not None
    with pytest.raises(FormatError, match=message) as caught:
        checked_episode(3, change(make_episode()))
    assert "episode 3" in str(caught.value)


def test_text_of_a_file_is_made_harmless(path):
    escape = "\x1b[31m\x07\u202e" + "x" * 10**5
    write(path, [make_episode(), make_episode()])
    set_metadata(path, origin=escape)
    origin = foreign.open_recording(path, max_bytes=2**30).origin
    assert origin is not None
    assert origin.startswith("?[31m??xxx")
    assert len(origin) <= 200
    for changes in ({"task": escape}, {"format": escape, "version": escape}):
        set_metadata(path, **changes)
        with pytest.raises(DemonstrationError) as caught:
            load(path)
        assert len(str(caught.value)) < 2000
        assert not {"\x1b", "\x07", "\u202e"} & set(str(caught.value))


def test_a_file_is_opened_as_often_for_many_episodes_as_for_few(path, monkeypatch):
    opened = []
    original = archive.open_regular

    def spy(*arguments):
        opened.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(archive, "open_regular", spy)
    counts = []
    for number in (2, 30):
        write(path, [make_episode()] * number)
        opened.clear()
        recording = foreign.open_recording(path, max_bytes=LIMIT)
        assert sum(1 for _ in recording.episodes) == number
        counts.append(len(opened))
    assert counts[0] == counts[1]
