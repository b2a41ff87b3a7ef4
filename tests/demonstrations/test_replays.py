"""Replay folders: alignment, order, what is left alone, damage and zip bombs."""

import io
import os
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import replays
from jaxil.demonstrations.readers.recording import FormatError
from tests.bounds import bounded
from tests.demonstrations.foreign_files import (
    dreamer_entries,
    drqv2_entries,
    play,
    read_here,
)
from tests.files.damaged_archives import replace_member, set_header_byte

MAX_BYTES = 10**6
WRITERS = {
    "DrQ-v2 replay": drqv2_entries,
    "DreamerV2 or V-D4RL replay": dreamer_entries,
}


def read(path, *, max_bytes=MAX_BYTES):
    return read_here(replays, path, max_bytes=max_bytes)[1]


def save(path, arrays, **changes):
    """Writes an archive; a change of None takes an array away."""
    arrays = {k: v for k, v in {**arrays, **changes}.items() if v is not None}
    np.savez_compressed(path, allow_pickle=True, **arrays)


def assert_shows(episode, played):
    for shown, expected in zip(episode[:3], played, strict=True):
        np.testing.assert_array_equal(shown, expected, strict=True)


PLAYED = play(np.random.default_rng(0), 5)
ENTRIES = dreamer_entries(*PLAYED)


@pytest.fixture(name="path")
def _path(tmp_path):
    """A valid file of one episode."""
    path = tmp_path / "episode.npz"
    save(path, ENTRIES)
    return path


# --- what is read ---------------------------------------------------------------------


@pytest.mark.parametrize("kind", WRITERS)
def test_episodes_come_by_name_with_actions_beside_their_frames(tmp_path, kind):
    played = [play(np.random.default_rng(k), 3 + k) for k in range(3)]
    for index in (2, 0, 1):
        name = f"20220101T00000{index}_{9 - index}_{3 + index}.npz"
        save(tmp_path / name, WRITERS[kind](*played[index]))
    recording, episodes = read_here(replays, tmp_path)
    assert recording.kind == kind
    assert recording.notes == ()
    for episode, expected in zip(episodes, played, strict=True):
        assert_shows(episode, expected)


@settings(deadline=None, max_examples=30)
@given(
    num_steps=st.integers(1, 5),
    size=st.sampled_from([4, 8, 64, 84]),
    num_stacked=st.integers(1, 4),
    channels_last=st.booleans(),
)
def test_stacks_of_any_size(
    tmp_path_factory, num_steps, size, num_stacked, channels_last
):
    played = play(np.random.default_rng(size), num_steps, size)
    entries = drqv2_entries(*played, num_stacked)
    if channels_last:
        entries["observation"] = entries["observation"].transpose(0, 2, 3, 1)
    path = tmp_path_factory.mktemp("any") / "episode.npz"
    np.savez(path, allow_pickle=False, **entries)
    assert replays.recognises(path)
    (episode,) = read(path)
    assert_shows(episode, played)


def test_channels_first_images_and_older_files(path):
    image = PLAYED[0].transpose(0, 3, 1, 2)
    save(path, ENTRIES, image=image, is_first=None, is_terminal=None)
    (episode,) = read(path)
    assert_shows(episode, PLAYED)


def test_numbers_of_other_types(path):
    action = ENTRIES["action"].astype(">f8")
    save(path, ENTRIES, action=action, reward=np.arange(6, dtype=np.int16))
    (episode,) = read(path)
    assert_shows(episode, (*PLAYED[:2], np.arange(1, 6, dtype=np.float32)))


def test_what_else_is_in_the_folder_is_left_alone(path, tmp_path):
    (tmp_path / "a.txt").write_text("text")
    (tmp_path / "a.pt").write_bytes(b"PK\3\4 not read")
    (tmp_path / "folder.npz").mkdir()
    os.mkfifo(tmp_path / "pipe.npz")  # opening it would wait for ever
    np.savez(tmp_path / "b.npz", x=np.zeros(3))
    save(tmp_path / "c.npz", ENTRIES, qpos=np.zeros(3), metadata=np.array("{}"))
    assert replays.recognises(tmp_path)
    assert not replays.recognises(tmp_path / "pipe.npz")
    recording, (episode,) = read_here(replays, tmp_path)
    assert recording.notes == ("2 of its 3 .npz files are not episodes.",)
    assert_shows(episode, PLAYED)
    with pytest.raises(FormatError, match="holds no episodes"):
        read(tmp_path / "pipe.npz")


def test_names_in_an_archive_are_no_paths(path, tmp_path):
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("../../escaped.npy", b"x")
        archive.writestr("/tmp/escaped.npy", b"x")
    (episode,) = read(path)
    assert_shows(episode, PLAYED)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert not (tmp_path.parent.parent / "escaped.npy").exists()


@pytest.mark.parametrize(
    "names",
    ["qpos metadata", "frames_0 metadata", "image action", "action reward", "x"],
)
def test_other_archives_are_not_recognised(path, tmp_path, names):
    assert replays.recognises(path)
    np.savez(path, allow_pickle=False, **{name: np.zeros(3) for name in names.split()})
    assert not replays.recognises(path)
    assert not replays.recognises(tmp_path)
    for place in (path, tmp_path):
        with pytest.raises(FormatError, match=r"holds no episodes: no \.npz file"):
            read(place)


def test_nothing_is_recognised_where_nothing_is(tmp_path):
    assert not replays.recognises(tmp_path)
    assert not replays.recognises(tmp_path / "none")
    (tmp_path / "a.npz").write_bytes(b"")
    assert not replays.recognises(tmp_path / "a.npz")


def test_one_episode_is_in_memory_at_a_time(tmp_path):
    num_bytes = 40 * 84 * 84 * 9
    for index in range(5):
        played = play(np.random.default_rng(index), 39, 84)
        np.savez_compressed(
            tmp_path / f"{index}.npz", allow_pickle=False, **drqv2_entries(*played)
        )
    # As compressed, as unpacked, as an array, and of single frames.
    with bounded(num_bytes=4 * num_bytes):
        recording = foreign.open_recording(tmp_path, max_bytes=2 * num_bytes)
        assert [len(each.frames) for each in recording.episodes] == [40] * 5


# --- what is refused ------------------------------------------------------------------


NAN = np.full((6, 2), np.nan, np.float32)
WRONG = {
    "more than one episode": (
        {"is_first": np.arange(6) % 3 == 0},
        "more than one episode: is_first is true again",
    ),
    "DreamerV3": ({"stepid": np.zeros((6, 20), np.uint8)}, "begins with a nonzero"),
    "actions after frames": (
        {"action": np.roll(ENTRIES["action"], -1, axis=0)},
        "begins with a nonzero action, so",
    ),
    "NaN for the reset": ({"action": NAN}, "begins with a nonzero"),
    "an action too few": (
        {"action": ENTRIES["action"][:-1]},
        r"different lengths or too short: .*'action': \(5, 2\)",
    ),
    "no steps": ({k: v[:1] for k, v in ENTRIES.items()}, "too short"),
    "a number": ({"reward": np.float32(0)}, "different lengths"),
    "grey pictures": (
        {"image": np.zeros((6, 8, 8, 1), np.uint8)},
        r"shape \(6, 8, 8, 1\), not ",
    ),
    "grey stacks": ({"image": np.zeros((6, 4, 84, 84), np.uint8)}, "not \\[T, 3 n"),
    "states": ({"image": np.zeros((6, 9))}, "observations of type float64, not uint8"),
    "flat pictures": (
        {"image": np.zeros((6, 192), np.uint8)},
        r"shape \(6, 192\), not ",
    ),
    "both ways": ({"image": np.zeros((6, 3, 3, 3), np.uint8)}, "ambiguous shape"),
    "objects": ({"action": np.array([{}] * 6, object)}, "action of Python objects"),
    "records": (
        {"action": np.zeros(6, [("x", float)])},
        r"unreadable array action \(not the header of a plain array",
    ),
}


@pytest.mark.parametrize("in_folder", [True, False])
@pytest.mark.parametrize("name", WRONG)
def test_files_that_break_the_rules_are_refused(path, name, in_folder):
    changes, message = WRONG[name]
    save(path, ENTRIES, **changes)
    with pytest.raises(FormatError, match=message) as caught:
        read(path.parent if in_folder else path)
    assert str(caught.value).startswith("holds episode.npz, which ") == in_folder
    assert "\n" not in str(caught.value)


def test_an_array_larger_than_may_be_read(path):
    # 6 pictures of 8 x 8 pixels, after a header of 128 bytes; and 462 bytes more.
    assert len(read(path, max_bytes=6 * 192 + 128 + 462)) == 1
    with pytest.raises(FormatError, match=r"1742 bytes in all .* more than the 1741"):
        read(path, max_bytes=1741)
    with pytest.raises(
        FormatError, match="image of 1280 bytes, more than the 1279 allowed"
    ):
        read(path, max_bytes=1279)


def test_a_file_cut_off_anywhere_is_refused(path, tmp_path):
    content = path.read_bytes()
    for length in range(0, len(content), 61):
        path.write_bytes(content[:length])
        for place in (path, tmp_path):
            with pytest.raises(FormatError, match="cut off"):
                read(place)


def test_a_damaged_file_is_named(tmp_path):
    for index in range(3):
        save(tmp_path / f"{index}.npz", ENTRIES)
    content = bytearray((tmp_path / "1.npz").read_bytes())
    content[400] ^= 0xFF  # within the compressed pictures
    (tmp_path / "1.npz").write_bytes(bytes(content))
    recording = foreign.open_recording(tmp_path, max_bytes=MAX_BYTES)
    assert_shows(next(recording.episodes), PLAYED)
    with pytest.raises(FormatError, match=r"holds 1\.npz, which is cut off, damaged"):
        next(recording.episodes)


def npy(header, data=b"", version=b"\1\0"):
    layout = "<H" if version[0] == 1 else "<I"
    length = struct.pack(layout, len(header))
    return b"\x93NUMPY" + version + length + header.encode() + data


def array(kind, shape, data=b"", version=b"\1\0"):
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }} \n"
    return npy(header, data, version)


HEADERS = {
    "nothing": (b"", "unreadable array action"),
    "no header": (b"\x93NUMPY\1\0\xff\xff", "unreadable array action"),
    "a later version": (array("<f4", "(6, 2)", version=b"\4\0"), "version"),
    "an expression": (npy("__import__('os')\n"), "not the header"),
    "deep": (npy("(" * 60_000), "not the header"),
    "deep version 2": (npy("[" * 10**5, version=b"\2\0"), "not the header"),
    "Python 2": (array("<f4", "(6L, 2L)"), "wrong length"),
    "deprecated": (array("|a5", "(6, 2)"), "wrong length"),
    "no such type": (array("<f3", "(6, 2)"), "unreadable array action"),
    "no size": (array("|S0", "(999999999999, 2)"), "not the header"),
    "negative": (array("<f4", "(-6, -2)", bytes(48)), "not the header"),
    "huge": (array("<f4", "(999999999999999999, 2)"), "wrong length"),
    "overflow": (array("<f4", "(4294967296, 4294967296)"), "claims a wrong length"),
    "empty and huge": (
        array("<f4", "(0, 999999999999999999)"),
        "different lengths|too big|too large",
    ),
    "many axes": (array("<f4", f"({'1, ' * 40})", bytes(4)), "different lengths"),
    "too long": (array("<f4", "(6, 2)", bytes(49)), "claims a wrong length"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_hostile_headers(path, name):
    content, message = HEADERS[name]
    replace_member(path, "action.npy", content)
    with pytest.raises(FormatError, match=message):
        read(path)


@pytest.mark.parametrize(
    ("unpacked", "declared", "message"),
    [
        (100_000_000, 200, "cut off, damaged"),
        (100_000_000, MAX_BYTES - 2000, "claims a wrong length"),
        (800, MAX_BYTES, "claims a wrong length"),
    ],
)
def test_sizes_that_are_not_true(path, unpacked, declared, message):
    action = array("<f4", f"({unpacked // 8}, 2)", bytes(unpacked - unpacked % 8))
    replace_member(path, "action.npy", action)
    size = struct.pack("<I", len(action))
    content = path.read_bytes()
    assert content.count(size) == 2
    path.write_bytes(content.replace(size, struct.pack("<I", declared)))
    with bounded(num_bytes=5 * MAX_BYTES), pytest.raises(FormatError, match=message):
        read(path)


def test_sizes_beyond_the_end_of_the_file(path):
    replace_member(path, "action.npy", b"short", zipfile.ZIP_STORED)
    content = path.read_bytes().replace(
        struct.pack("<II", 5, 5), struct.pack("<II", 9 * 10**8, 9 * 10**8)
    )
    path.write_bytes(content)
    refused = pytest.raises(FormatError, match="claims a wrong length")
    with bounded(num_bytes=MAX_BYTES), refused:
        read(path, max_bytes=10**9)


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compressions_that_cannot_be_stopped_half_way(path, compression):
    action = io.BytesIO()
    np.save(action, ENTRIES["action"], allow_pickle=False)
    replace_member(path, "action.npy", action.getvalue(), compression)
    with pytest.raises(FormatError, match="unsupported compression"):
        read(path)


def test_encrypted_members(path):
    set_header_byte(path, 6, 1)  # bit 0 of the flags
    with pytest.raises(FormatError, match="encrypted"):
        read(path)
