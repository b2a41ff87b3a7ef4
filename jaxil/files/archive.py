"""Reading NumPy archives (.npz) that may be damaged, or made to do damage."""

import errno
import io
import math
import os
import pathlib
import re
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping

import numpy as np

from jaxil.files.untrusted import require_regular

MAX_MEMBER_BYTES = 2 * 1024**3
# What zipfile raises for bytes that are not as they should be.
_DAMAGES = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    RuntimeError,  # encrypted; and NotImplementedError, such as a later version
)

# How many bytes one compressed byte can stand for, at most.
_MAX_RATIOS = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 1032}
_LENGTH_FORMATS = {(1, 0): "<H", (2, 0): "<I"}  # of an .npy header, by version
_HEADER = re.compile(
    rb"\{'descr': '([<>|=][biufcSUVOmM]\d{0,9})', 'fortran_order': (?:True|False), "
    rb"'shape': \(((?:\d{1,18}(?:, \d{1,18}){0,31},?)?)\), \} *\n"
)


def member_names(path: pathlib.Path) -> frozenset[str]:
    """Returns the names of an archive's arrays; none if it is no archive."""
    try:
        require_regular(path)
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, ValueError, *_DAMAGES):
        return frozenset()
    return frozenset(name.removesuffix(".npy") for name in names)


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
    require_regular(path)
    try:
        with zipfile.ZipFile(path) as archive:
            stored = {info.filename: info for info in archive.infolist()}
            missing = [name for name in max_bytes if f"{name}.npy" not in stored]
            if missing:
                raise ValueError(f"has no array {', '.join(missing)}")
            return {
                name: _read_member(
                    archive, stored[f"{name}.npy"], name, limit, path.stat().st_size
                )
                for name, limit in max_bytes.items()
            }
    except OSError as error:
        if error.errno != errno.EINVAL:  # a place before the file's beginning
            raise
        raise ValueError(
            "is cut off, damaged or no .npz file (a bad offset)"
        ) from error
    except _DAMAGES as error:
        raise ValueError(f"is cut off, damaged or no .npz file ({error})") from error


def _read_member(
    archive: zipfile.ZipFile,
    info: zipfile.ZipInfo,
    name: str,
    limit: int,
    file_bytes: int,
) -> np.ndarray:
    if info.file_size > limit:
        raise ValueError(
            f"has an array {name} of {info.file_size} bytes, more than the {limit} "
            "that are accepted"
        )
    if info.compress_type not in _MAX_RATIOS:
        raise ValueError("is packed by a compression that is not read")
    if (
        info.compress_size > file_bytes
        or info.file_size > info.compress_size * _MAX_RATIOS[info.compress_type]
    ):
        raise ValueError(f"has an array {name} that is not as long as it says")
    # Asked for by its size: `read()` would unpack up to 2 GB before it looks.
    with archive.open(info) as member:
        content = io.BytesIO(member.read(info.file_size))
    try:
        shape, dtype = _read_header(content)
    except (ValueError, TypeError) as error:
        raise ValueError(f"has an unreadable array {name} ({error})") from error
    if dtype.hasobject:
        raise ValueError(f"has an array {name} of Python objects, not of numbers")
    num_bytes = math.prod(shape) * dtype.itemsize
    if content.tell() + num_bytes != len(content.getbuffer()):
        raise ValueError(f"has an array {name} that is not as long as it says")
    content.seek(0)
    return np.lib.format.read_array(content, allow_pickle=False)


def _read_header(content: io.BytesIO) -> tuple[tuple[int, ...], np.dtype]:
    """Returns shape and type of an .npy file, which may not be all that Python knows.

    NumPy's own function evaluates the header as an expression, and hostile ones make
    it raise anything, or warn.
    """
    version = np.lib.format.read_magic(content)
    if version not in _LENGTH_FORMATS:
        raise ValueError(f"version {version} of the .npy format")
    length_format = _LENGTH_FORMATS[version]
    (length,) = struct.unpack(
        length_format, content.read(struct.calcsize(length_format))
    )
    header = _HEADER.fullmatch(content.read(length))
    if header is None:
        raise ValueError("not the header of a plain array")
    descr, sizes = (group.decode() for group in header.groups())
    dtype = np.dtype(descr)
    if dtype.itemsize == 0:
        raise ValueError("its items have no size")
    return tuple(int(size) for size in sizes.split(",") if size.strip()), dtype


def write_archive(path: pathlib.Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Writes a compressed archive, whole or not at all.

    Args:
      path: the file.
      arrays: pairs of a name and an array; taken one at a time, so that they need not
        all be in memory.

    Raises:
      OSError: the folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
    temporary = pathlib.Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
                for name, array in arrays:
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                        np.lib.format.write_array(member, array, allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)  # mkstemp's is for the owner only
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
