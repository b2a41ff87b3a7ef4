"""The folder of a report: written under another name, then renamed."""

import contextlib
import os
import pathlib
import shutil
import uuid
from collections.abc import Iterator

from jaxil.files.writing import obstacle, wrong_name

# This line marks index.html as a report, so that only reports are replaced.
MARK = '<meta name="generator" content="jaxil.report">'
_MARK_WITHIN = 2000  # characters
_SUBFOLDERS = {"figures": (".png", ".svg"), "tables": (".csv",)}


def problems(output: pathlib.Path) -> list[str]:
    """Returns one sentence for each reason why no report can be written there."""
    name = f"--output={str(output)!r}"
    real = pathlib.Path(os.path.realpath(output))
    try:
        if os.path.exists(real) and not os.path.isdir(real):
            return [f"{name} is a file; name a new folder, such as --output=report"]
        if why := wrong_name(real) or obstacle(real.parent):
            return [f"{name} cannot be written ({why}); name another folder"]
        stranger = _stranger(real) if os.path.isdir(real) else None
    except OSError as error:
        return [f"{name} cannot be read ({error.strerror}); name another folder"]
    if stranger is None:
        return []
    return [
        f"{name} holds {stranger}, which is no part of a report and would be replaced; "
        "name a new folder, or empty this one yourself"
    ]


@contextlib.contextmanager
def replaced(output: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a new folder, and renames it to `output` at the end.

    An exception leaves `output` unchanged. A kill may leave hidden folders beside it;
    between the two renames, one of them is the old report.

    Raises:
      OSError: it cannot be written.
    """
    real = pathlib.Path(os.path.realpath(output))
    real.parent.mkdir(parents=True, exist_ok=True)
    new = real.with_name(f".{uuid.uuid4().hex}.report.tmp")
    old = new.with_suffix(".old")
    new.mkdir()
    try:
        for name in _SUBFOLDERS:
            (new / name).mkdir()
        yield new
        if real.exists():
            real.rename(old)
        new.rename(real)
    except BaseException:
        if old.exists() and not real.exists():
            old.rename(real)
        raise
    finally:
        shutil.rmtree(new, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


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
