"""Reading NumPy archives (.npz) that may be damaged, or made to do damage."""

import io
import math
import os
import pathlib
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Mapping

import numpy as np

MAX_MEMBER_BYTES = 2 * 1024**3


def read_archive(
    path: pathlib.Path, *, max_bytes: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """Reads arrays of an archive; never unpickles, and never allocates unasked.

    The sizes that the archive and the arrays' headers declare are compared with each
    other and with the limit before anything is unpacked.

    Args:
      path: the file.
      max_bytes: names of the arrays to read, each with the largest size to accept,
        in bytes, unpacked. Others in the file are not looked at.

    Raises:
      OSError: the file cannot be opened.
      ValueError: says what is wrong with it, as the end of a sentence that begins
        with the file's name.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            stored = {info.filename: info for info in archive.infolist()}
            missing = [name for name in max_bytes if f"{name}.npy" not in stored]
            if missing:
                raise ValueError(f"has no array {', '.join(missing)}")
            return {
                name: _read_member(archive, stored[f"{name}.npy"], name, limit)
                for name, limit in max_bytes.items()
            }
    except (
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
        EOFError,
        NotImplementedError,  # an unknown compression
        RuntimeError,  # encrypted
    ) as error:
        raise ValueError(f"is cut off, damaged or no .npz file ({error})") from error


def _read_member(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str, limit: int
) -> np.ndarray:
    if info.file_size > limit:
        raise ValueError(
            f"has an array {name} of {info.file_size} bytes, more than the {limit} "
            "that are accepted"
        )
    # Bounded by the size just checked, whatever the compressed bytes unpack to.
    with archive.open(info) as member:
        content = io.BytesIO(member.read())
    try:
        version = np.lib.format.read_magic(content)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, _, dtype = read_header(content)
    except (ValueError, KeyError, SyntaxError) as error:
        raise ValueError(f"has an unreadable array {name} ({error})") from error
    if dtype.hasobject:
        raise ValueError(f"has an array {name} of Python objects, not of numbers")
    num_bytes = math.prod(shape) * dtype.itemsize
    if content.tell() + num_bytes != len(content.getbuffer()):
        raise ValueError(f"has an array {name} that is not as long as it says")
    content.seek(0)
    return np.lib.format.read_array(content, allow_pickle=False)


def write_archive(path: pathlib.Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes a compressed archive, whole or not at all.

    Raises:
      OSError: the folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
    temporary = pathlib.Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)  # mkstemp's is for the owner only
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
