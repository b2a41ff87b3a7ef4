"""Files and folders that are replaced as a whole: at any kill, the old or the new."""

import contextlib
import os
import pathlib
import re
import shutil
import time
import uuid
from collections.abc import Iterator

# Also the names that earlier versions gave to what they had not finished.
_TEMPORARY = re.compile(
    r"\.tmp-.*|\.(saving|deleting|writing)_.*|\..*\.tmp(\.mp4)?|config\.json\.\d+\.tmp"
)


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Yields a temporary path; what the block writes there then becomes `path`.

    The temporary name has the ending of `path`. If the block fails, it is removed.
    """
    path = pathlib.Path(path)
    # A name has at most 255 bytes, so not all of a long one fits.
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
    """Replaces a file as a whole."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def remove(path: pathlib.Path) -> None:
    """Removes a file, or a folder with all that is in it, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def remove_leftovers(folder: pathlib.Path, *, min_age_seconds: float = 0.0) -> None:
    """Removes what killed processes left unfinished in a folder, if it exists.

    Args:
      folder: its subfolders are not searched.
      min_age_seconds: spares files that another process may be writing now.
    """
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if _TEMPORARY.fullmatch(path.name):
            # Another process may have removed it in the meantime.
            with contextlib.suppress(FileNotFoundError):
                if time.time() - path.lstat().st_mtime >= min_age_seconds:
                    remove(path)
