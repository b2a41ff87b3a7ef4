"""The folder of a run: who may write there, and with which settings."""

import contextlib
import fcntl
import json
import os
import pathlib
from collections.abc import Iterator
from typing import Any

from jaxil.config import Config, default_config
from jaxil.errors import UsageError

# A run may be prolonged, or be computed in another way, without becoming another run.
_FREE_FIELDS = ("total_frames", "encoder.convolutions", "replay_on_device")
# Older runs have these, which said how something is computed and nothing else.
_FORMER_FIELDS = (("encoder", "chunk_size"),)


def problems(workdir: pathlib.Path, config: Config) -> list[str]:
    """Returns one sentence for each reason why a run can't live in a folder.

    Args:
      workdir: need not exist; it is not made.
      config: must be that of the run that is in the folder already, if there is one.
    """
    parent = workdir
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        return [
            f"workdir={str(workdir)!r} can't be written: {parent} must be a folder "
            "that you may write; choose another with --workdir=DIR"
        ]
    if not (workdir / "config.json").exists():
        return []
    try:
        before = read_config(workdir)
    except UsageError as error:
        return [str(error)]
    different = _differences(before, config)
    if different:
        return [
            f"workdir={str(workdir)!r} holds a run with other settings ("
            + "; ".join(different)
            + "): use the same to go on with it, or another --workdir"
        ]
    return []


@contextlib.contextmanager
def opened(workdir: pathlib.Path) -> Iterator[None]:
    """Makes the folder and keeps other processes out of it while it is open.

    Raises:
      UsageError: the folder can't be written or is in use.
    """
    try:
        workdir.mkdir(parents=True, exist_ok=True)
        lock = (workdir / "lock").open("w")
    except OSError as error:
        raise UsageError(
            f"workdir={str(workdir)!r} can't be written ({error.strerror}); choose a "
            "folder of your own with --workdir=DIR"
        ) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UsageError(
                f"workdir={str(workdir)!r} is in use by another process; wait for it "
                "or choose another folder with --workdir=DIR"
            ) from error
        yield


def read_config(workdir: pathlib.Path) -> Config:
    """Returns the config of the run in a folder.

    Fields that did not exist when it was written have their defaults: these are what
    was done before there was a choice. Those that exist no longer are left out.

    Raises:
      UsageError: there is none, or it can't be read.
    """
    path = workdir / "config.json"
    try:
        stored = json.loads(path.read_text())["config"]
        config = default_config(stored["method"], stored["task"])
        for section, field in _FORMER_FIELDS:
            stored.get(section, {}).pop(field, None)
        config.update(stored)
        return config
    except OSError as error:
        raise UsageError(
            f"workdir={str(workdir)!r} holds no run: {path} can't be read "
            f"({error.strerror}); give the --workdir of a `jaxil.launch`"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{path} is damaged ({error}); restore it, or start in another folder"
        ) from error


def write_config(
    workdir: pathlib.Path, config: Config, machine: dict[str, Any]
) -> None:
    """Writes config.json: every setting in force, and what it runs on."""
    text = json.dumps({"config": config.to_dict(), **machine}, indent=2)
    temporary = workdir / f"config.json.{os.getpid()}.tmp"
    temporary.write_text(text + "\n")
    os.replace(temporary, workdir / "config.json")


def _differences(there: Config, here: Config) -> list[str]:
    # Through JSON, which turns tuples into lists, so that both have the same types.
    before = _flat(json.loads(json.dumps(there.to_dict())))
    now = _flat(json.loads(json.dumps(here.to_dict())))
    return [
        f"{field}: {before.get(field)!r} there, {now.get(field)!r} here"
        for field in sorted(before.keys() | now.keys())
        if before.get(field) != now.get(field) and field not in _FREE_FIELDS
    ]


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            leaves.update(_flat(value, f"{prefix}{name}."))
        else:
            leaves[f"{prefix}{name}"] = value
    return leaves
