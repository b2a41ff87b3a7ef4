"""The folder of a run: one process at a time, always with the same settings."""

import contextlib
import json
import os
import pathlib
import re
from collections.abc import Iterator, Sequence
from typing import Any

from jaxil import config as jaxil_config
from jaxil import outside
from jaxil.config import Config
from jaxil.demonstrations import states
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments import tasks
from jaxil.errors import Fault, UsageError, collecting, printable
from jaxil.files import locking, writing
from jaxil.files.settings import as_stored, flat
from jaxil.files.untrusted import read_regular

# A checkpoint's name: its frame, and a number if there are several of that frame.
CHECKPOINT = re.compile(r"frame_(\d{12,})(?:_(\d+))?")
_SOURCE, _DIGEST = "demonstrations.source", "demonstrations_digest"
# No file of a run takes longer between two writes.
_LEFTOVER_SECONDS = 60.0
_MAX_CONFIG_BYTES = 10**7


class RunFolderError(Exception):
    """The files of a run cannot be written or read; the message says what to do."""


def flag_problems(values: Any) -> Sequence[Fault | str]:
    """Returns why the flag `--workdir` names no folder; nothing if it does."""
    faults: list[str | Fault] = []
    with collecting(faults):
        from_flag(values.workdir)
    return faults


def from_flag(value: str | None) -> pathlib.Path:
    """Returns the folder that `--workdir` names.

    Raises:
      UsageError: it is missing, empty, or not a name that a file can have.
    """
    if not value:
        way_out = "name a folder, such as --workdir=runs/1"
        raise UsageError(f"--workdir is missing or empty: {way_out}")
    try:
        value.encode()
    except UnicodeEncodeError as error:
        message = f"--workdir={value!r} is not UTF-8; choose a name that is"
        raise UsageError(message) from error
    if why := writing.wrong_name(value):
        raise UsageError(f"--workdir has {why}; choose another")
    return pathlib.Path(value)


def run_problems(values: Any) -> Sequence[Fault | str]:
    """Returns why there is no run in the folder of the flag `--workdir`."""
    if found := flag_problems(values):
        return found
    folder = pathlib.Path(values.workdir)
    try:
        _read_json(folder / "config.json")
    except OSError as error:
        return [_holds_no_run(folder, error)]
    except (ValueError, RecursionError):
        pass  # damaged: `read_config` says how
    return ()


def _holds_no_run(workdir: pathlib.Path, error: OSError) -> str:
    return (
        f"workdir={str(workdir)!r} holds no run: {workdir / 'config.json'} is not "
        f"readable ({error.strerror}); give the --workdir of a `jaxil train`"
    )


def output_problems(values: Any) -> Sequence[Fault | str]:
    """Returns why no run can be written to the folder of the flag `--workdir`."""
    found = flag_problems(values)
    return found or _place_problems(pathlib.Path(values.workdir))


def _place_problems(workdir: pathlib.Path) -> list[Fault]:
    if why := writing.obstacle(workdir):
        way_out = "choose another with --workdir=DIR"
        return [Fault("workdir", f"is not writable ({why})", way_out, str(workdir))]
    return []


def problems(workdir: pathlib.Path, config: Config) -> list[Fault]:
    """Returns every reason why a run of a config cannot use a folder.

    It need not exist, and is not created.
    """
    if faults := _place_problems(workdir):
        return faults
    if not os.path.exists(workdir / "config.json"):
        if newest_checkpoint(workdir) is None:
            return []
        rule = "has checkpoints but no config.json, to say which run they belong to"
        way_out = "restore it, or choose another with --workdir=DIR"
        return [Fault("workdir", rule, way_out, str(workdir))]
    try:
        before = read_config(workdir)
    except UsageError as error:
        return [Fault("workdir", f"cannot be resumed: {error}", value=str(workdir))]
    different = _differences(before, config)
    stored = _read_json(workdir / "config.json").get(_DIGEST)
    if stored is not None and jaxil_config.uses_demonstrations(config):
        # Their content decides, not their path.
        different = [each for each in different if not each.startswith(_SOURCE)]
        if demonstrations_digest(config) not in (stored, None):
            different.append(f"{_SOURCE}: its content has changed since")
    if different:
        rule = f"holds a run with other settings ({'; '.join(different)})"
        way_out = "use the same to resume it, or another --workdir"
        return [Fault("workdir", rule, way_out, str(workdir))]
    return []


@contextlib.contextmanager
def opened(workdir: pathlib.Path) -> Iterator[None]:
    """Creates and locks the folder; removes unfinished files of killed processes.

    Raises:
      UsageError: the folder is not writable or in use.
    """
    with contextlib.ExitStack() as stack:
        try:
            workdir.mkdir(parents=True, exist_ok=True)
            stack.enter_context(locking.locked(workdir / "lock"))
            for folder in (workdir, workdir / "videos"):
                writing.remove_leftovers(folder, min_age_seconds=_LEFTOVER_SECONDS)
        except locking.InUseError as error:
            raise UsageError(
                f"workdir={str(workdir)!r} is {error}; wait for it or choose another "
                "folder with --workdir=DIR"
            ) from error
        except OSError as error:
            raise UsageError(
                f"workdir={str(workdir)!r} is not writable ({error.strerror}); choose "
                "a folder of your own with --workdir=DIR"
            ) from error
        yield


@contextlib.contextmanager
def writes_to(workdir: pathlib.Path) -> Iterator[None]:
    """Turns an OSError of the block, which writes a run's files, into a RunFolderError.

    That names the fault, the newest checkpoint and what to do.
    """
    try:
        yield
    except OSError as error:
        if not workdir.is_dir():
            raise RunFolderError(
                f"workdir={str(workdir)!r} has been deleted or moved; if it was moved, "
                "rerun the command with its new name to resume from its newest "
                "checkpoint"
            ) from error
        name = f" ({pathlib.Path(error.filename).name})" if error.filename else ""
        newest = newest_checkpoint(workdir)
        checkpoint = "none yet" if newest is None else f"of frame {newest}"
        raise RunFolderError(
            f"workdir={str(workdir)!r} cannot be written: {error.strerror or error}"
            f"{name}; newest checkpoint: {checkpoint}. Make room or make it writable, "
            "then rerun the same command to resume"
        ) from error


def newest_checkpoint(workdir: pathlib.Path) -> int | None:
    """Returns the environment frame of the newest checkpoint in a folder, or None."""
    try:
        names = os.listdir(workdir / "checkpoints")
    except OSError:
        return None
    matches = [match for name in names if (match := CHECKPOINT.fullmatch(name))]
    return max((int(match[1]) for match in matches), default=None)


def read_config(workdir: pathlib.Path, *, imports_task: bool = True) -> Config:
    """Returns the config of the run in a folder, which may be somebody else's.

    Fields that are newer than the run have their defaults, which are how older versions
    behaved. Fields that no longer exist are left out.

    Args:
      workdir: the folder.
      imports_task: whether the task's code will be imported, so that the user must
        have named it unless it is jaxil's.

    Raises:
      UsageError: there is no config, it cannot be read, or it names code that the user
        has not (see `outside.require_trusted`).
    """
    path = workdir / "config.json"
    try:
        stored = _read_json(path)["config"]
        method, task = str(stored["method"]), str(stored["task"])
        code = {"method": method} if ":" in method else {}
        if imports_task and tasks.names_code(task):
            code["task"] = task
        outside.require_trusted(code, path)
        config = jaxil_config.defaults(method, task)
        known = jaxil_config.fields(method)
        there = flat(stored)
        for field in known.keys() & there.keys():
            group, _, leaf = field.rpartition(".")
            value = there[field]
            target = config[group] if group else config
            target[leaf] = tuple(value) if isinstance(value, list) else value
        return config
    except OSError as error:
        raise UsageError(_holds_no_run(workdir, error)) from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(
            f"{path} is damaged ({error}); restore it, or start in another folder"
        ) from error


def write_config(
    workdir: pathlib.Path, config: Config, machine: dict[str, Any]
) -> None:
    """Writes config.json: all settings, and the machine.

    Raises:
      RunFolderError: the folder is not writable.
    """
    content = {"config": config.to_dict(), **machine}
    if jaxil_config.uses_demonstrations(config):
        content[_DIGEST] = demonstrations_digest(config)
    text = json.dumps(content, indent=2)
    with writes_to(workdir):
        writing.write_atomically(workdir / "config.json", f"{text}\n".encode())


def demonstrations_digest(config: Config) -> str | None:
    """Returns a digest of what the demonstrations' file holds; None if unreadable."""
    try:
        source = config.demonstrations.source
        if source:
            return states.digest(pathlib.Path(os.path.expanduser(source)))
        return states.digest(states.shipped_path(config.task))
    except DemonstrationError:
        return None


def _read_json(path: pathlib.Path) -> dict[str, Any]:
    return json.loads(read_regular(path, _MAX_CONFIG_BYTES))


def _differences(there: Config, here: Config) -> list[str]:
    before, now = flat(as_stored(there.to_dict())), flat(as_stored(here.to_dict()))
    fields = (before.keys() | now.keys()) - {*jaxil_config.FREE_FIELDS}
    return [
        f"{field}: {_shown(before, field)} there, {_shown(now, field)} here"
        for field in sorted(fields)
        if before.get(field) != now.get(field)
    ]


def _shown(settings: dict[str, Any], field: str) -> str:
    return printable(repr(settings.get(field)), 100)
