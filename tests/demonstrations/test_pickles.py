"""Pickles of demonstrations: alignment, every form and protocol, and hostile ones."""

import collections
import functools
import os
import pickle
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.demonstrations.readers import pickles, unpickling
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import (
    PICKLE_FORMS,
    pickle_content,
    play,
    stacked,
)

MAX_BYTES = 10**6
PROTOCOLS = (2, 3, 4, 5)


def read(path, content, *, max_bytes=MAX_BYTES):
    """Writes bytes, or the pickle of something, and reads all of it."""
    if not isinstance(content, bytes):
        content = pickle.dumps(content, 4)
    path.write_bytes(content)
    recording = pickles.open_recording(path, max_bytes=max_bytes)
    episodes = list(recording.episodes)
    assert len(episodes) == recording.num_episodes
    return episodes


def assert_shows(episode, played):
    """Compares with what was played, as far as the file can know it."""
    frames, actions, rewards = played
    np.testing.assert_array_equal(episode.frames, frames[:-1], strict=True)
    np.testing.assert_array_equal(episode.actions, actions[:-1], strict=True)
    np.testing.assert_array_equal(episode.rewards, rewards[:-1], strict=True)


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
    content = pickle.dumps(pickle_content(played, form), protocol)
    for episode, expected in zip(read(path, content), played, strict=True):
        assert_shows(episode, expected)


@settings(deadline=None, max_examples=40)
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
    for episode, expected in zip(
        read(path, pickle.dumps(tuple(content), protocol)), played, strict=True
    ):
        assert_shows(episode, expected)


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
    for episode, expected in zip(
        read(path, pickle.dumps(content, protocol)), played, strict=True
    ):
        assert_shows(episode, expected)


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
    played = play(np.random.default_rng(0), 5)
    content = pickle_content([played], "lists of arrays")
    content[column] = [change(content[column][0])]
    for protocol in PROTOCOLS:
        (episode,) = read(path, pickle.dumps(content, protocol))
        assert_shows(episode, played)


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
    played = play(np.random.default_rng(0), 5)
    content = pickle_content([played], "arrays")
    content[1] = states
    for protocol in PROTOCOLS:
        (episode,) = read(path, pickle.dumps(content, protocol))
        assert_shows(episode, played)


def test_actions_and_rewards_may_be_missing(path):
    content = pickle_content([play(np.random.default_rng(0), 5)], "arrays")
    (episode,) = read(path, [content[0], None, None, None])
    assert episode.frames.shape == (5, 8, 8, 3)
    assert episode.actions is None
    assert episode.rewards is None


def test_files_of_numpy_1(path):
    played = [play(np.random.default_rng(0), 5)] * 1
    for protocol in PROTOCOLS:
        content = pickle.dumps(pickle_content(played, "lists of arrays"), protocol)
        old = content.replace(
            b"\x16numpy._core.multiarray", b"\x15numpy.core.multiarray"
        )
        old = old.replace(b"\x13numpy._core.numeric", b"\x12numpy.core.numeric")
        old = old.replace(b"cnumpy._core.", b"cnumpy.core.")
        assert old != content
        if protocol >= 4:  # all of it is one frame, with a length
            old = old[:3] + struct.pack("<Q", len(old) - 11) + old[11:]
        (episode,) = read(path, old)
        assert_shows(episode, played[0])


def python2_array(array) -> bytes:
    """Returns the instructions by which Python 2 pickled an array of uint8 [K, T, ...].

    As its `cPickle` and `pickletools.dis` show them; strings there are bytes.
    """
    data = array.tobytes()
    return b"".join(
        [
            b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n",
            b"K\0\x85U\1b\x87R(K\1(" + bytes(x for n in array.shape for x in (75, n)),
            b"tcnumpy\ndtype\nU\2u1K\0K\1\x87R(K\3U\1|NNNJ\xff\xff\xff\xff",
            b"J\xff\xff\xff\xffK\0tb\x89T"
            + struct.pack("<i", len(data))
            + data
            + b"tb",
        ]
    )


def test_files_of_python_2(path):
    frames, _, _ = play(np.random.default_rng(0), 5)
    array = python2_array(stacked(frames)[None])
    (episode,) = read(path, b"\x80\2](" + array + b"NNNe.")
    np.testing.assert_array_equal(episode.frames, frames)


def test_one_episode_is_in_memory_at_a_time(path):
    num_bytes = 20 * 9 * 84 * 84
    observations = np.zeros((8, 20, 9, 84, 84), np.uint8)
    path.write_bytes(pickle.dumps([observations, None, None, None], 4))
    del observations
    tracemalloc.start()
    try:
        recording = pickles.open_recording(path, max_bytes=num_bytes)
        assert tracemalloc.get_traced_memory()[1] < num_bytes / 4
        for _ in recording.episodes:
            pass
        assert tracemalloc.get_traced_memory()[1] < 2 * num_bytes
    finally:
        tracemalloc.stop()


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
    """Its pickle calls a function."""

    def __init__(self, function, *arguments):
        self._call = function, arguments

    def __reduce__(self):
        return self._call


CANARY = "executed-by-a-pickle"
UINT8 = b"cnumpy\ndtype\n\x8c\2u1\x85R"
OBJECT = b"cnumpy\ndtype\n\x8c\2O8\x85R"
EMPTY = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\0\x85C\1b\x87R"
HUGE = b"\x8a\6" + (2**40).to_bytes(6, "little")
ARRAY = python2_array(np.zeros((1, 2, 3, 4, 4), np.uint8))
ARRAY_OF_50 = python2_array(np.zeros((50, 50, 3, 1, 1), np.uint8))
STEP = python2_array(np.zeros((3, 4, 4), np.uint8))
EPISODE = python2_array(np.zeros((2, 3, 4, 4), np.uint8))

HOSTILE = {
    # What executes.
    "call": (b"cos\nsystem\n\x8c\4true\x85R.", "imports os.system, which"),
    "call by name": (b"\x8c\2os\x8c\6system\x93)R.", "imports os.system, which"),
    "instance": (b"(ios\nsystem\n.", "imports os.system, which"),
    "known instance": (b"(inumpy\nndarray\n.", "makes an object"),
    "dotted": (b"\x8c\5numpy\x8c\x10f2py.os.system\1\1\x93.", "imports numpy.f2py.os"),
    "control characters": (b"c\x1b[2J\nx\n.", r"imports \\x1b\[2J.x, which"),
    "long name": (b"c" + b"a" * 900 + b"\nx\n.", "imports a{80}, which"),
    "new object": (b"cnumpy\nndarray\n)\x81.", r"instruction b'\\x81'"),
    "persistent id": (b"Px\n.", "instruction b'P'"),
    "extension": (b"\x82\1.", r"instruction b'\\x82'"),
    "text integer": (b"I" + b"9" * 5000 + b"\n.", "instruction b'I'"),
    # Functions of NumPy in ways that only an attacker uses.
    "ndarray": (b"cnumpy\nndarray\n" + HUGE + b"\x85\x85R.", "calls numpy.ndarray in"),
    "allocation": (
        b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"
        + HUGE
        + b"\x85C\1b\x87R.",
        "calls numpy.core.multiarray._reconstruct in",
    ),
    "object scalar": (
        b"cnumpy.core.multiarray\nscalar\n" + OBJECT + b"C\x08AAAAAAAA\x86R.",
        "calls numpy.core.multiarray.scalar in",
    ),
    "long scalar": (
        b"cnumpy.core.multiarray\nscalar\n" + UINT8 + b"C\2AA\x86R.",
        "calls numpy.core.multiarray.scalar in",
    ),
    "object buffer": (
        b"cnumpy.core.numeric\n_frombuffer\n(C\x08AAAAAAAA" + OBJECT + b"K\1\x85UAtR.",
        "cut off",
    ),
    "objects from bytes": (
        EMPTY + b"(K\1K\1\x85" + OBJECT + b"\x89C\x08AAAAAAAAtb.",
        "not as long as it says",
    ),
    "huge shape": (
        EMPTY + b"(K\1" + HUGE + HUGE + b"\x86" + UINT8 + b"\x89C\2AAtb.",
        "not as long as it says",
    ),
    "a shape of less": (
        ARRAY_OF_50.replace(b"K\x32K\x32K\3", b"K\x32K\x31K\3", 1) + b".",
        "not as long as it says",
    ),
    "huge shape without items": (
        b"](" + EMPTY + b"(K\1" + HUGE + b"K\0\x86" + UINT8 + b"\x89C\0tbNNNe.",
        "observations that are no array",
    ),
    "negative shape": (
        EMPTY + b"(K\1J\xff\xff\xff\xffJ\xfe\xff\xff\xff\x86" + UINT8 + b"\x89C\2AAtb.",
        "impossible shape",
    ),
    "many axes": (
        EMPTY + b"(K\1(" + b"K\1" * 70 + b"t" + UINT8 + b"\x89C\1Atb.",
        "impossible shape",
    ),
    "shape of lists": (
        EMPTY + b"(K\1]\x85" + UINT8 + b"\x89C\1Atb.",
        "impossible shape",
    ),
    "state of a list": (b"]Nb.", "sets the state"),
    "state twice": (ARRAY + b"(K\1K\1\x85" + UINT8 + b"\x89C\1Atb.", "sets the state"),
    "call of a number": (b"K\1)R.", "calls something"),
    "call without arguments": (b"cnumpy\ndtype\nNR.", "damaged before byte"),
    # Lengths that are not true.
    "bytes": (b"B\xff\xff\xff\x7f.", "cut off"),
    "long bytes": (b"\x8e" + b"\xff" * 7 + b"\x7f.", "cut off"),
    "longest bytes": (b"\x8e" + b"\xff" * 8 + b".", "cut off"),
    "byte array": (b"\x96" + b"\xff" * 8 + b".", "cut off"),
    "text": (b"\x8d" + b"\xff" * 8 + b".", "cut off"),
    "string": (b"T\xff\xff\xff\xff.", "cut off"),
    "frame": (b"\x95" + b"\xff" * 8 + b"N.", "cut off"),
    "integer": (b"\x8b\xff\xff\xff\x7f.", r"instruction b'\\x8b'"),
    # Stack and memo.
    "empty": (b".", "damaged before byte"),
    "no mark": (b"]Ne.", "damaged before byte"),
    "no memo": (b"h\1.", "damaged before byte"),
    "no list": (b"NNa.", "damaged before byte"),
    "no tuple": (b"N\x87.", "damaged before byte"),
    "no text": (b"\x8c\1\xff.", "damaged before byte"),
    "no names": (b"NN\x93.", "damaged before byte"),
    "far memo": (b"Nr\xff\xff\xff\xff.", "not of a list"),
    "list of itself": (b"]q\0(h\0h\0h\0h\0e.", "no array and no list"),
    "deep lists": (b"](" + b"]" * 60_000 + b"a" * 59_999 + b"NNNe.", "no array"),
    "deep tuples": (b"](N" + b"\x85" * 60_000 + b"NNNe.", "no array and no list"),
    "deep key": (b"}N" + b"\x85" * 60_000 + b"Ns.", "not of a list"),
    "deep arguments": (
        b"cnumpy\ndtype\nN" + b"\x85" * 60_000 + b"R.",
        "numpy.dtype in",
    ),
    "deep state": (UINT8 + b"N" + b"\x85" * 60_000 + b"b.", "sets the state|not of a"),
    "one episode a hundred times": (
        b"](](" + EPISODE + b"q\0" + b"h\0" * 99 + b"eNNNe.",
        "one array several times",
    ),
    "one step ten thousand times": (
        b"](]](" + STEP + b"q\0" + b"h\0" * 10_000 + b"eaNNNe.",
        "one array several times",
    ),
    "one list of numbers again and again": (
        b"](" + ARRAY_OF_50 + b"NN](](" + b"K\0" * 50 + b"eq\1" + b"h\1" * 49 + b"ee.",
        "one array several times",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_and_not_executed(path, name):
    content, message = HOSTILE[name]
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match=message):
            read(path, b"\x80\4" + content)
        assert tracemalloc.get_traced_memory()[1] < 30e6 + 100 * len(content)
    finally:
        tracemalloc.stop()


def test_memory_is_not_for_what_the_file_only_names(path):
    step = python2_array(np.zeros((3, 100, 100), np.uint8))
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match="one array several times"):
            read(
                path,
                b"\x80\4](]](" + step + b"q\0" + b"h\0" * 10_000 + b"eaNNNe.",
                max_bytes=10**9,
            )
        assert tracemalloc.get_traced_memory()[1] < 10**6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    ("value", "name"),
    [
        (Executes(os.system, f"touch {CANARY}"), "posix.system|nt.system"),
        (Executes(eval, f"open({CANARY!r}, 'w')"), "eval"),
        (Executes(np.load, CANARY), "numpy.load"),
        (Executes(functools.partial, print), "functools.partial"),
        (collections.OrderedDict(a=1), "collections.OrderedDict"),
        (np.random.default_rng(0), "numpy.random"),
        ({1, 2}, "__builtin__.set|builtins.set|instruction"),
        (object(), "copy_reg|copyreg|builtins.object|__builtin__.object"),
    ],
)
def test_nothing_else_is_imported(path, tmp_path, monkeypatch, value, name, protocol):
    monkeypatch.chdir(tmp_path)
    content = pickle_content([play(np.random.default_rng(0), 3)], "arrays")
    content[1] = [value]
    with pytest.raises(FormatError, match=name) as caught:
        read(path, pickle.dumps(content, protocol))
    assert str(caught.value).endswith("nothing was executed")
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_buffers_outside_of_the_file(path):
    content = pickle_content([play(np.random.default_rng(0), 3)], "arrays")
    with pytest.raises(FormatError, match="kept elsewhere"):
        read(path, pickle.dumps(content, 5, buffer_callback=lambda _: None))


def test_instructions_without_end(path, monkeypatch):
    monkeypatch.setattr(unpickling, "_MAX_INSTRUCTIONS", 1000)
    for num_appended, is_read in ((900, True), (1000, False)):
        content = b"\x80\4](" + ARRAY + b"](" + b"N" * num_appended + b"eNNe."
        if is_read:
            assert len(read(path, content)) == 1
        else:
            with pytest.raises(FormatError, match="more than 1000 instructions"):
                read(path, content)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_file_cut_off_anywhere_is_refused(path, protocol):
    played = [play(np.random.default_rng(0), 2)]
    content = pickle.dumps(pickle_content(played, "lists of arrays"), protocol)
    for length in range(0, len(content), 7):
        with pytest.raises(FormatError, match=r"cut off|no pickle|damaged"):
            read(path, content[:length])


def test_text_is_no_array(path):
    content = pickle.dumps(
        pickle_content([play(np.random.default_rng(0), 9)], "arrays"), 2
    )
    start = content.index(b"\xc3\xbf")  # ÿ, the last character that is a byte
    with pytest.raises(FormatError, match="text in the place"):
        read(path, content[:start] + b"\xc4\x80" + content[start + 2 :])


def test_an_array_larger_than_may_be_read(path):
    content = pickle_content([play(np.random.default_rng(0), 5)] * 2, "arrays")
    limit = 5 * 9 * 8 * 8
    read(path, content, max_bytes=limit)
    for observations in (content[0], np.asfortranarray(content[0]), [[*content[0][0]]]):
        numbers = rf"{limit}|{2 * limit} bytes .* than the {limit - 1} that"
        with pytest.raises(FormatError, match=numbers):
            read(path, [observations, None, None, None], max_bytes=limit - 1)


def changed(change):
    """Returns sound content of two episodes after a change to its columns."""
    rng = np.random.default_rng(0)
    content = pickle_content([play(rng, 4), play(rng, 4)], "lists of arrays")
    result = change(content)
    return content if result is None else result


WRONG = {
    "nothing": (lambda c: [], "not of a list"),
    "three columns": (lambda c: c[:3], "not of a list"),
    "a dictionary": (lambda c: {"observations": c[0]}, "not of a list"),
    "a number": (lambda c: [1, 2, 3, 4], "observations that are no array"),
    "no episodes": (lambda c: [[], [], [], []], "holds no episode"),
    "an episode too few": (
        lambda c: c.__setitem__(2, c[2][:1]),
        "holds 2 episodes, but actions of 1",
    ),
    "an action too few": (
        lambda c: c[2].__setitem__(1, c[2][1][:-1]),
        r"episode 1 of unequal or too few steps: .*'actions': \(3, 2\)",
    ),
    "one step": (
        lambda c: [[c[i][0][:1]] for i in range(4)],
        "episode 0 of unequal or too few steps",
    ),
    "grey pictures": (
        lambda c: c.__setitem__(0, [x[:, :4] for x in c[0]]),
        r"shape \(4, 4, 8, 8\), where coloured pictures",
    ),
    "real pictures": (
        lambda c: c.__setitem__(0, [x / 255 for x in c[0]]),
        "observations of type float64, where uint8",
    ),
    "states only": (lambda c: c.__setitem__(0, c[1]), "type float64, where uint8"),
    "actions without axis": (
        lambda c: c.__setitem__(2, [x[:, 0] for x in c[2]]),
        r"actions of type float32 and shape \(3,\), where numbers on 2 axes",
    ),
    "complex rewards": (
        lambda c: c.__setitem__(3, [x + 0j for x in c[3]]),
        "rewards that are no array",
    ),
    "objects on two axes": (
        lambda c: c.__setitem__(2, np.array([[1.0, None]] * 2, object)),
        "actions that are no array",
    ),
    "text": (
        lambda c: c.__setitem__(2, ["left", "right"]),
        "actions that are no array",
    ),
    "a huge number": (
        lambda c: c.__setitem__(3, [[0, 0, 0, 10**400]] * 2),
        "rewards that are too large|damaged|instruction",
    ),
    "a picture of another size": (
        lambda c: c[0].__setitem__(0, [*c[0][0][:3], c[0][0][3, :, :6]]),
        "observations of different shapes in one episode",
    ),
    "too deep": (
        lambda c: c.__setitem__(2, [[[[[1.0]]]]] * 2),
        "actions that are no array",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_other_content_is_refused(path, name):
    change, message = WRONG[name]
    with pytest.raises(FormatError, match=message) as caught:
        read(path, changed(change))
    assert "\n" not in str(caught.value)


def test_a_number_too_large_for_float32_is_left_to_the_caller(path):
    (episode, _) = read(
        path, changed(lambda c: c.__setitem__(3, [[0, 1e300, 0, 0]] * 2))
    )
    assert episode.rewards is not None
    assert np.isinf(episode.rewards[0])


@pytest.mark.parametrize("folder", [True, False])
def test_a_file_that_cannot_be_opened(tmp_path, folder):
    path = tmp_path if folder else tmp_path / "none.pkl"
    with pytest.raises(OSError, match=r"Is a directory|No such file"):
        pickles.open_recording(path, max_bytes=MAX_BYTES)
