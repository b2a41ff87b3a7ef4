"""Reads NumPy archives (.npz), even damaged or hostile ones; writes them atomically."""

import contextlib
import errno
import io
import math
import os
import pathlib
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from typing import BinaryIO

import numpy as np

from jaxil.files import writing
from jaxil.files.untrusted import open_regular

MAX_BYTES = 2 * 1024**3
# What zipfile raises on damage, encryption (RuntimeError) and unsupported features
# (NotImplementedError, a RuntimeError).
_DAMAGES = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError)
# The highest compression ratio of each method.
_MAX_RATIOS = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 1032}
_MAX_HEADER_BYTES = 2**14  # of an .npy file; NumPy itself stops at 10000
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def member_names(path: pathlib.Path) -> frozenset[str]:
    """Returns the names of an archive's arrays; empty for any other file."""
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            names = archive.namelist()
    except (OSError, ValueError, *_DAMAGES):
        return frozenset()
    return frozenset(name.removesuffix(".npy") for name in names)


class Reader:
    """Reads arrays of an archive."""

    def __init__(self, file: BinaryIO) -> None:
        """Opens an archive in a file; raises ValueError if it is damaged."""
        with _damages_reported():
            self._archive = zipfile.ZipFile(file)
        self._file_bytes = os.fstat(file.fileno()).st_size
        self._stored = {info.filename: info for info in self._archive.infolist()}

    def read(self, max_bytes: Mapping[str, int]) -> dict[str, np.ndarray]:
        """Returns arrays; arguments and errors as of `read_archive`."""
        with _damages_reported():
            missing = [name for name in max_bytes if f"{name}.npy" not in self._stored]
            if missing:
                raise ValueError(f"has no array {', '.join(missing)}")
            members = {name: self._stored[f"{name}.npy"] for name in max_bytes}
            for name, info in members.items():
                _check_size(name, info, max_bytes[name], self._file_bytes)
            num_bytes = sum(info.file_size for info in members.values())
            budget = max(max_bytes.values(), default=0)
            if num_bytes > budget:
                raise ValueError(
                    f"has arrays of {num_bytes} bytes in all ({', '.join(members)})"
                    f", more than the {budget} allowed"
                )
            for name, info in members.items():
                _check_header(self._archive, name, info)
            return {k: _unpack(self._archive, info) for k, info in members.items()}


@contextlib.contextmanager
def opened(path: pathlib.Path) -> Iterator[Reader]:
    """Opens an archive to read arrays one after another; raises as `read_archive`."""
    with open_regular(path) as file:
        yield Reader(file)


def read_archive(
    path: pathlib.Path, *, max_bytes: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """Reads arrays of an archive without unpickling.

    Sizes are checked in the headers of archive and arrays before anything is unpacked.

    `max_bytes` names the arrays to read and limits the unpacked size of each; the
    largest limit also holds for all of them together.

    Raises:
      OSError: the file cannot be opened, or is not a regular file.
      ValueError: the file is damaged or too large; the message continues a sentence
        that begins with the file's name.
    """
    with opened(path) as reader:
        return reader.read(max_bytes)


@contextlib.contextmanager
def _damages_reported() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno != errno.EINVAL:  # a seek to before the file's start
            raise
        raise ValueError("is cut off, damaged or no .npz file") from error
    except _DAMAGES as error:
        raise ValueError(f"is cut off, damaged or no .npz file ({error})") from error


def _check_size(name: str, info: zipfile.ZipInfo, limit: int, file_bytes: int) -> None:
    if info.file_size > limit:
        raise ValueError(
            f"has an array {name} of {info.file_size} bytes, more than the {limit} "
            "allowed"
        )
    if info.compress_type not in _MAX_RATIOS:
        raise ValueError("uses an unsupported compression method")
    most_bytes = info.compress_size * _MAX_RATIOS[info.compress_type]
    if info.compress_size > file_bytes or info.file_size > most_bytes:
        raise ValueError(f"has an array {name} whose header claims a wrong length")


def _check_header(archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> None:
    with archive.open(info) as member:
        start = io.BytesIO(member.read(_MAX_HEADER_BYTES))
    try:
        version = np.lib.format.read_magic(start)
        if version not in _HEADER_READERS:
            raise ValueError(f"version {version} of the .npy format")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shape, _, dtype = _HEADER_READERS[version](start)
        is_plain = dtype.itemsize and not dtype.fields and not dtype.subdtype
        if not is_plain or min(shape, default=0) < 0:
            raise ValueError(f"shape {shape} of {dtype}")
    except Exception as error:  # NumPy evaluates the header, which may raise anything
        reason = f"not the header of a plain array: {str(error)[:100]}"
        raise ValueError(f"has an unreadable array {name} ({reason})") from error
    if dtype.hasobject:
        raise ValueError(f"has an array {name} of Python objects, not of numbers")
    if start.tell() + math.prod(shape) * dtype.itemsize != info.file_size:
        raise ValueError(f"has an array {name} whose header claims a wrong length")


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as member, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.lib.format.read_array(member, allow_pickle=False)


def write_archive(
    path: pathlib.Path, arrays: Iterable[tuple[str, np.ndarray]], *, level: int = 6
) -> None:
    """Writes named arrays atomically; only one at a time has to be in memory.

    The file's folder is created. `level` is that of compression, from 0 to 9.
    """
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        writing.replacing(path) as temporary,
        zipfile.ZipFile(temporary, "w", method, compresslevel=level) as archive,
    ):
        for name, array in arrays:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
