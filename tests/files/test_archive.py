"""Archives that ask for more of zipfile than it can do are refused in words."""

import os
import pathlib
import struct

import numpy as np
import pytest

from jaxil.files import archive
from tests.bounds import bounded

# An entry of a zip file's directory, "PK\1\2": the version needed to read it, tenfold,
# and the flags stand at these places (PKWARE's APPNOTE, 4.3.12).
ENTRY, VERSION, FLAGS = b"PK\1\2", 6, 8
ENCRYPTED, PATCHED, STRONGLY_ENCRYPTED = 1 << 0, 1 << 5, 1 << 6


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "numbers.npz"
    archive.write_archive(path, [("numbers", np.arange(4.0))])
    return path


def alter(path, offset, value):
    """Changes two bytes of the one entry in an archive's directory."""
    content = bytearray(path.read_bytes())
    assert content.count(ENTRY) == 1
    struct.pack_into("<H", content, content.index(ENTRY) + offset, value)
    path.write_bytes(content)


def read(path):
    return archive.read_archive(path, max_bytes={"numbers": 1000})["numbers"]


def test_what_is_written_is_read(path):
    np.testing.assert_array_equal(read(path), np.arange(4.0))
    assert archive.member_names(path) == {"numbers"}
    alter(path, FLAGS, 0)  # as it was: altering by itself spoils nothing
    np.testing.assert_array_equal(read(path), np.arange(4.0))


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (ENCRYPTED, "encrypted"),
        (PATCHED, "compressed patched data"),
        (STRONGLY_ENCRYPTED, "strong encryption"),
    ],
)
def test_a_member_that_cannot_be_unpacked(path, flags, reason):
    alter(path, FLAGS, flags)
    with pytest.raises(ValueError, match=f"cut off, damaged or no .npz.*{reason}"):
        read(path)


def test_an_archive_of_a_later_version(path):
    alter(path, VERSION, 99)
    with pytest.raises(ValueError, match=r"damaged or no .npz.*zip file version 9\.9"):
        read(path)
    assert archive.member_names(path) == frozenset()


def test_all_arrays_together_are_bounded_before_any_is_unpacked(tmp_path):
    path, size = tmp_path / "many.npz", 4_000_000
    zeros = np.zeros(size, np.uint8)
    archive.write_archive(path, [(f"array{index}", zeros) for index in range(5)])
    assert path.stat().st_size < 50_000
    limits = {f"array{index}": size + 200 for index in range(5)}  # each by itself fits
    refused = pytest.raises(ValueError, match=f"in all .* more than the {size + 200}")
    with bounded(num_bytes=1_000_000), refused:
        archive.read_archive(path, max_bytes=limits)
    limits["array0"] = 6 * size  # the largest of the limits is that of all together
    assert len(archive.read_archive(path, max_bytes=limits)) == 5


def test_a_flipped_byte_is_noticed_or_without_effect(tmp_path):
    path = tmp_path / "numbers.npz"
    numbers = np.arange(40.0)
    archive.write_archive(path, [("numbers", numbers)], level=0)
    content = path.read_bytes()
    num_refused = 0
    for place in range(len(content)):
        damaged = bytearray(content)
        damaged[place] ^= 0x10
        path.write_bytes(bytes(damaged))
        try:
            found = read(path)
        except ValueError:
            num_refused += 1
        else:
            np.testing.assert_array_equal(found, numbers)
    assert num_refused > numbers.nbytes


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_only_regular_files_are_opened(kind, tmp_path):
    path = {"device": pathlib.Path("/dev/zero"), "folder": tmp_path}.get(kind)
    if path is None:
        path = tmp_path / "pipe"
        os.mkfifo(path)
    with pytest.raises(OSError, match="not a regular file"):
        archive.read_archive(path, max_bytes={"numbers": 1000})
    assert archive.member_names(path) == frozenset()
