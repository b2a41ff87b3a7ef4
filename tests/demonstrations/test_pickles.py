"""Pickles of demonstrations: alignment, every form and protocol, and hostile ones."""

import functools
import os
import pickle
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import pickles
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import (
    PICKLE_FORMS,
    pickle_content,
    play,
    python2_pickle,
    read_here,
    stacked,
)

PROTOCOLS = (2, 3, 4, 5)
PLAYED = play(np.random.default_rng(0), 5)


def read(path, content, **options):
    """Writes bytes, or the pickle of something, and reads all of it."""
    if not isinstance(content, bytes):
        content = pickle.dumps(content, 4)
    path.write_bytes(content)
    return read_here(pickles, path, **options)[1]


def assert_shows(episode, played):
    """Compares with what was played, as far as the file can know it."""
    frames, actions, rewards = played
    np.testing.assert_array_equal(episode.frames, frames[:-1], strict=True)
    np.testing.assert_array_equal(episode.actions, actions[:-1], strict=True)
    np.testing.assert_array_equal(episode.rewards, rewards[:-1], strict=True)


def assert_reads(path, content, played, protocols=PROTOCOLS):
    """Reads the pickles of something, which must show what was played."""
    for protocol in protocols:
        episodes = read(path, pickle.dumps(content, protocol))
        for episode, expected in zip(episodes, played, strict=True):
            assert_shows(episode, expected)


@pytest.fixture(name="path")
def _path(tmp_path):
    return tmp_path / "expert_demos.pkl"


# --- what is read ---------------------------------------------------------------------


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("form", PICKLE_FORMS)
def test_each_action_and_reward_is_beside_its_frame(path, form, protocol):
    rng = np.random.default_rng(protocol)
    lengths = (6, 6) if form == "arrays" else (3, 6)
    played = [play(rng, length, size=16) for length in lengths]
    assert_reads(path, pickle_content(played, form), played, [protocol])


@settings(deadline=None, max_examples=20)
@given(
    lengths=st.lists(st.integers(2, 5), min_size=1, max_size=4),
    size=st.integers(1, 20),
    num_stacked=st.integers(1, 4),
    protocol=st.sampled_from(PROTOCOLS),
    fortran=st.booleans(),
)
def test_any_sizes(tmp_path_factory, lengths, size, num_stacked, protocol, fortran):
    played = [
        play(np.random.default_rng(size), length, size + 3 * num_stacked)
        for length in lengths
    ]
    content = pickle_content(played, "lists of arrays")
    content[0] = [stacked(frames, num_stacked)[:-1] for frames, _, _ in played]
    if fortran:
        content[0] = [np.asfortranarray(stacks) for stacks in content[0]]
    path = tmp_path_factory.mktemp("any") / "demos.pkl"
    assert_reads(path, tuple(content), played, [protocol])


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    "stored",
    [
        np.asfortranarray,
        lambda array: array.swapaxes(0, 1).copy().swapaxes(0, 1),  # steps slowest
        lambda array: array.swapaxes(1, -1).copy().swapaxes(1, -1),
        lambda array: np.repeat(array, 2, axis=0)[::2],  # with gaps
    ],
)
def test_arrays_in_any_order(path, stored, protocol):
    played = [play(np.random.default_rng(k), 5) for k in range(3)]
    content = [stored(x) for x in pickle_content(played, "arrays")]
    assert_reads(path, content, played, [protocol])


@pytest.mark.parametrize(
    ("change", "column"),
    [
        (lambda rewards: rewards.astype(">f8"), 3),
        (lambda rewards: rewards[:, None], 3),
        (lambda rewards: rewards.tolist(), 3),
        (lambda rewards: tuple(rewards), 3),  # of NumPy's scalars
        (lambda actions: actions.astype(">f4"), 2),
        (lambda actions: actions.tolist(), 2),
    ],
)
def test_numbers_of_any_type(path, change, column):
    content = pickle_content([PLAYED], "lists of arrays")
    content[column] = [change(content[column][0])]
    assert_reads(path, content, [PLAYED])


def test_large_numbers(path):
    content = pickle_content([play(np.random.default_rng(0), 4)], "lists of arrays")
    content[3] = [[0, -(2**40), 2**100, 255]]
    for protocol in PROTOCOLS:
        (episode,) = read(path, pickle.dumps(content, protocol))
        expected = np.array([-(2.0**40), 2.0**100, 255], np.float32)
        np.testing.assert_array_equal(episode.rewards, expected, strict=True)


@pytest.mark.parametrize(
    "states",
    [
        None,
        [],
        np.zeros((1, 0)),
        np.array(["text"]),
        np.zeros(2, [("x", float), ("y", object)]),
        [{"a": {"b": (1, 2.5, "ü" * 2000, 10**30)}}, b"bytes" * 1000],
        np.zeros(3, complex),
    ],
)
def test_states_may_be_anything_that_needs_no_import(path, states):
    content = pickle_content([PLAYED], "arrays")
    content[1] = states
    assert_reads(path, content, [PLAYED])


def test_actions_and_rewards_may_be_missing(path):
    content = pickle_content([PLAYED], "arrays")
    (episode,) = read(path, [content[0], None, None, None])
    assert episode.frames.shape == (5, 8, 8, 3)
    assert episode.actions is None
    assert episode.rewards is None


def test_files_of_numpy_1(path):
    for protocol in PROTOCOLS:
        content = pickle.dumps(pickle_content([PLAYED], "lists of arrays"), protocol)
        old = content.replace(b"cnumpy._core.", b"cnumpy.core.")
        old = old.replace(b"\x16numpy._core.mul", b"\x15numpy.core.mul")
        old = old.replace(b"\x13numpy._core.num", b"\x12numpy.core.num")
        assert old != content
        if protocol >= 4:  # all of it is one frame, with a length
            old = old[:3] + struct.pack("<Q", len(old) - 11) + old[11:]
        (episode,) = read(path, old)
        assert_shows(episode, PLAYED)


def test_files_of_python_2(path):
    array = python2_pickle(stacked(PLAYED[0])[None])
    (episode,) = read(path, b"\x80\2](" + array + b"NNNe.")
    np.testing.assert_array_equal(episode.frames, PLAYED[0])


def test_recognised_by_content(path, tmp_path):
    for protocol in PROTOCOLS:
        path.write_bytes(pickle.dumps([1], protocol))
        assert pickles.recognises(path)
    for content in (b"", b"\x80", b"PK\3\4", pickle.dumps([1], 0), b"\x80\6."):
        path.write_bytes(content)
        assert not pickles.recognises(path)
    assert not pickles.recognises(tmp_path)
    assert not pickles.recognises(tmp_path / "none")


# --- what is refused ------------------------------------------------------------------


class Executes:
    """Pickled as a call."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    ("value", "name"),
    [
        (Executes(os.system, "touch canary"), "posix.system"),
        (Executes(eval, "open('canary', 'w')"), "eval"),
        (Executes(getattr, np.zeros(3), "tofile"), "getattr"),
        (Executes(np.load, "canary"), "numpy.load"),
        (Executes(functools.partial, print), "functools.partial"),
        (np.random.default_rng(0), "numpy.random"),
        ({1, 2}, "__builtin__.set|builtins.set"),
        (object(), "copy_reg|copyreg|builtins.object|__builtin__.object"),
        (Executes, "Executes"),
    ],
)
def test_nothing_else_is_imported(path, tmp_path, monkeypatch, value, name, protocol):
    if protocol >= 4 and isinstance(value, set):
        pytest.skip("sets have an instruction of their own, which imports nothing")
    monkeypatch.chdir(tmp_path)
    content = pickle_content([PLAYED], "arrays")
    content[1] = [value]
    with pytest.raises(FormatError, match=rf"imports .*({name})") as caught:
        read(path, pickle.dumps(content, protocol))
    assert str(caught.value).endswith("nothing was executed")
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\0\x85C\1b\x87R"
UINT8 = b"cnumpy\ndtype\nC\2u1\x85R"
OBJECT = b"cnumpy\ndtype\nC\1O\x85R"
HUGE = b"\x8a\6" + b"\xff" * 5 + b"\0"
HOSTILE = {
    "objects from bytes": ARRAY + b"(K\1K\1\x85" + OBJECT + b"\x89C\x08AAAAAAAAtb.",
    "huge shape": ARRAY + b"(K\1" + HUGE + HUGE + b"\x86" + UINT8 + b"\x89C\2AAtb.",
    "much memory": b"cnumpy\nndarray\n" + HUGE + b"\x85\x85R.",
    "object buffer": (
        b"cnumpy.core.numeric\n_frombuffer\n(C\x08AAAAAAAA" + OBJECT + b"K\1\x85C\1CtR."
    ),
    "longest bytes": b"\x8e" + b"\xff" * 7 + b"\x7f.",
    "not a container": b"N.",
    "list of itself": b"]q\0(h\0h\0h\0h\0e.",
    "deep lists": b"](" + b"]" * 60_000 + b"a" * 59_999 + b"NNNe.",
    "state of a function": (b"](cnumpy.core.numeric\n_frombuffer\n}C\1xK\1sbNNNe."),
    "objects elsewhere": b"](NQNNNe.",
    "nothing at all": b"",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_with_a_sentence(path, name):
    path.write_bytes(b"\x80\4" + HOSTILE[name])
    with pytest.raises(FormatError) as caught:
        list(foreign.open_recording(path, max_bytes=10**6).episodes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("depth", [0, 1])
def test_one_array_named_again_and_again_is_refused(path, depth):
    steps = stacked(PLAYED[0])
    many = [steps] * 100 if depth == 0 else [[steps[0]] * 10_000]
    with pytest.raises(FormatError, match=r"one array several times|than the 1000000"):
        read(path, [many, None, None, None], max_bytes=10**6)


def test_buffers_outside_of_the_file(path):
    content = pickle_content([PLAYED], "arrays")
    path.write_bytes(pickle.dumps(content, 5, buffer_callback=lambda _: None))
    with pytest.raises(FormatError, match="cut off or damaged"):
        foreign.open_recording(path, max_bytes=10**6)


def test_a_file_cut_off_is_refused(path):
    content = pickle.dumps(pickle_content([PLAYED], "lists of arrays"), 4)
    for length in (2, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(FormatError, match="cut off or damaged"):
            foreign.open_recording(path, max_bytes=10**6)


def test_an_array_larger_than_may_be_read(path):
    content = pickle_content([PLAYED] * 2, "arrays")
    limit = 5 * 9 * 8 * 8
    read(path, content, max_bytes=limit)
    for observations in (content[0], np.asfortranarray(content[0]), [[*content[0][0]]]):
        with pytest.raises(FormatError, match=rf"{limit} bytes, more than the"):
            read(path, [observations, None, None, None], max_bytes=limit - 1)


FRAMES, _, ACTIONS, REWARDS = range(4)  # the columns
WRONG = {
    "nothing": (None, lambda _: [], "not a pickle of"),
    "three columns": (None, lambda columns: columns[:3], "not a pickle of"),
    "a dictionary": (None, lambda c: {"observations": c[0]}, "not a pickle of"),
    "a number": (None, lambda _: [1, 2, 3, 4], "observations that are neither array"),
    "no episodes": (None, lambda _: [[], [], [], []], "holds no episode"),
    "one step": (None, lambda c: [[x[0][:1]] for x in c], "has 1 frames"),
    "an episode too few": (
        ACTIONS,
        lambda x: x[:1],
        "holds 2 episodes, but actions of",
    ),
    "an action too few": (
        ACTIONS,
        lambda x: [x[0], x[1][:-1]],
        r"has different lengths in episode 1: .*'actions': \(3, 2\)",
    ),
    "grey pictures": (
        FRAMES,
        lambda episodes: [x[:, :4] for x in episodes],
        r"shape \(4, 4, 8, 8\), not ",
    ),
    "real pictures": (
        FRAMES,
        lambda episodes: [x / 255 for x in episodes],
        "observations of type float64, not uint8",
    ),
    "a picture of another size": (
        FRAMES,
        lambda x: [[*x[0][:3], x[0][3, :, :6]], x[1]],
        "observations of different shapes in one episode",
    ),
    "complex rewards": (
        REWARDS,
        lambda episodes: [x + 0j for x in episodes],
        "rewards that are neither array",
    ),
    "text": (ACTIONS, lambda _: ["left", "right"], "actions that are neither array"),
    "too deep": (ACTIONS, lambda _: [[[[[1.0]]]]] * 2, "actions that are neither"),
}


@pytest.mark.parametrize("name", WRONG)
def test_other_content_is_refused(path, name):
    column, change, message = WRONG[name]
    rng = np.random.default_rng(0)
    content: Any = pickle_content([play(rng, 4), play(rng, 4)], "lists of arrays")
    if column is None:
        content = change(content)
    else:
        content[column] = change(content[column])
    with pytest.raises(FormatError, match=message) as caught:
        read(path, content)
    assert "\n" not in str(caught.value)
