"""The folder of a report: made aside, then put in its place as a whole."""

import contextlib
import ctypes
import os
import pathlib
import shutil
import uuid
from collections.abc import Iterator

# By this line index.html is known as ours, so that only reports are replaced.
MARK = '<meta name="generator" content="jaxil.report">'
_MARK_WITHIN = 2000  # characters
_SUBFOLDERS = {"figures": (".png", ".svg"), "tables": (".csv",)}
_EXCHANGE = 2  # RENAME_EXCHANGE of renameat2(2)
_HERE = -100  # AT_FDCWD


def problems(output: pathlib.Path) -> list[str]:
    """Returns one sentence for each reason why no report can be written there."""
    name = f"--output={str(output)!r}"
    real = pathlib.Path(os.path.realpath(output))
    if real.exists() and not real.is_dir():
        return [f"{name} is a file; name a folder to be made, such as --output=report"]
    parent = real.parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        return [
            f"{name} can't be written: {parent} must be a folder that you may write"
        ]
    if not real.is_dir():
        return []
    try:
        stranger = _stranger(real)
    except OSError as error:
        return [f"{name} can't be read ({error.strerror}); name another folder"]
    if stranger is None:
        return []
    return [
        f"{name} holds {stranger}, which no report has written, and would be replaced; "
        "name a folder to be made, or empty it yourself"
    ]


@contextlib.contextmanager
def replaced(output: pathlib.Path) -> Iterator[pathlib.Path]:
    """Gives a new folder, and puts it in the place of `output` at the end.

    After an exception `output` is as it was; after a kill it is the old folder or the
    new one, and a hidden folder may be left beside it.

    Raises:
      OSError: if it can't be written.
    """
    real = pathlib.Path(os.path.realpath(output))
    real.parent.mkdir(parents=True, exist_ok=True)
    new = real.with_name(f".{real.name}.{uuid.uuid4().hex}.tmp")
    new.mkdir()
    try:
        for name in _SUBFOLDERS:
            (new / name).mkdir()
        yield new
        if real.exists():
            _exchange(new, real)
        else:
            new.rename(real)
    finally:
        # What was there before, or what did not become a report.
        shutil.rmtree(new, ignore_errors=True)


def _stranger(folder: pathlib.Path) -> str | None:
    """Returns the name of something in a folder that no report has written."""
    entries = sorted(folder.iterdir())
    if not entries:
        return None
    index = folder / "index.html"
    if not index.is_file():
        return entries[0].name
    with index.open(errors="replace") as file:
        if MARK not in file.read(_MARK_WITHIN):
            return index.name
    for entry in entries:
        endings = _SUBFOLDERS.get(entry.name)
        if endings is not None and entry.is_dir() and not entry.is_symlink():
            for inner in sorted(entry.iterdir()):
                if inner.suffix not in endings or not inner.is_file():
                    return f"{entry.name}/{inner.name}"
        elif entry != index:
            return entry.name
    return None


def _exchange(new: pathlib.Path, old: pathlib.Path) -> None:
    """Swaps two folders, at one stroke where the system can."""
    try:
        swap = ctypes.CDLL(None, use_errno=True).renameat2
        if swap(_HERE, os.fsencode(new), _HERE, os.fsencode(old), _EXCHANGE) == 0:
            return
    except (AttributeError, OSError):  # another libc, another system
        pass
    aside = new.with_name(new.name.replace(".tmp", ".old"))
    old.rename(aside)
    try:
        new.rename(old)
    except BaseException:
        aside.rename(old)
        raise
    shutil.rmtree(aside, ignore_errors=True)
