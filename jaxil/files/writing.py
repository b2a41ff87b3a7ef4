"""Atomic replacement of files and folders: a kill leaves the old or the new one."""

import contextlib
import os
import pathlib
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterator

_TEMPORARY = re.compile(r"\.tmp-.*|\.deleting_.*")
_MAX_NAME_BYTES = 255


def wrong_name(path: str | os.PathLike) -> str | None:
    """Returns why no file can have a path; None if one can."""
    parts = pathlib.Path(path).absolute().parts
    longest = max(parts, key=lambda part: len(os.fsencode(part)))
    length = len(os.fsencode(longest))
    if length > _MAX_NAME_BYTES:
        return f"a name of {length} bytes, {longest[:40]!r}...: at most 255 are allowed"
    return "a zero byte in its name" if any("\0" in part for part in parts) else None


def obstacle(folder: str | os.PathLike) -> str | None:
    """Returns why nothing can be written in a folder, which need not exist; else None.

    Tried with a file without a name: permissions alone do not tell a read-only disk.
    """
    if why := wrong_name(folder):
        return why
    path = pathlib.Path(folder).absolute()
    # Not pathlib's `exists`, which raises in folders that it may not search.
    nearest = next(each for each in (path, *path.parents) if os.path.exists(each))
    try:
        with tempfile.TemporaryFile(dir=nearest):
            return None
    except OSError as error:
        return f"{nearest}: {error.strerror or error}"


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Yields a temporary path with the same suffix, which then replaces `path`.

    If the block fails, what it wrote is removed.
    """
    path = pathlib.Path(path)
    # File names are limited to 255 bytes.
    temporary = path.with_name(f".tmp-{uuid.uuid4().hex[:12]}-{path.name[-32:]}")
    try:
        yield temporary
        if temporary.is_file():
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        remove(temporary)


def write_atomically(path: str | os.PathLike, content: bytes) -> None:
    """Writes a file, replacing an old one atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def remove(path: pathlib.Path) -> None:
    """Removes a file or a whole folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def remove_leftovers(folder: pathlib.Path, *, min_age_seconds: float = 0.0) -> None:
    """Removes temporary files of killed processes from a folder, not its subfolders.

    Younger ones than `min_age_seconds` stay: another process may be writing them.
    """
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if _TEMPORARY.fullmatch(path.name):
            with contextlib.suppress(FileNotFoundError):  # removed by another process
                if time.time() - path.lstat().st_mtime >= min_age_seconds:
                    remove(path)
