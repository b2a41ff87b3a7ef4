"""Archives that ask for more of zipfile than it can do are refused in words."""

import struct

import numpy as np
import pytest

from jaxil.files import archive

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
