"""Finds runs and reads their files, which may be incomplete or damaged."""

import functools
import json
import os
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxil import config as jaxil_config
from jaxil import errors, methods
from jaxil.files import tables, untrusted
from jaxil.files.settings import as_stored, flat
from jaxil.reporting import figures

# Large folders of a run; they hold no other runs.
_OWN_FOLDERS = ("checkpoints", "replay", "tensorboard", "videos", "wandb")
_RETURN = "task_return_mean"
_FAILED = "failed.json"  # of `jaxil sweep`
# What every run writes; a config without it is damaged.
_NEEDED = {"method": str, "task": str, "seed": int, "total_frames": int}
# Beyond any true setting, return or time; sums of larger ones would overflow.
LARGEST = 1e15
_MAX_REASON = 200  # characters of a file's fault that are shown
_MAX_CONFIG_BYTES = 10**7

Table = Mapping[str, np.ndarray]  # by column


class UnreadableError(Exception):
    """A config.json that is damaged or of no run; continues a sentence about it."""


class Run(NamedTuple):
    """One run, as read from its folder."""

    folder: pathlib.Path
    name: str  # the folder as text
    config: Mapping[str, Any]  # by dotted name, with defaults for missing settings
    variant: figures.Variant
    evaluation: Table  # eval.csv, rising frames, finite returns. Shapes [E]
    training: Table  # train.csv, rising frames. Shapes [R]
    device: str  # what it computed on
    remarks: tuple[str, ...]  # warnings, one sentence each

    @property
    def task(self) -> str:
        """Such as "walker_walk"."""
        return self.config["task"]

    @property
    def seed(self) -> int:
        """The seed."""
        return self.config["seed"]

    @property
    def returns(self) -> np.ndarray:
        """Mean task return of each evaluation. Shape [E]."""
        return self.evaluation[_RETURN]

    @property
    def frames(self) -> float:
        """Environment frames so far, by either table; 0 if both are empty."""
        return self._last("frame")

    @property
    def seconds(self) -> float:
        """Seconds so far; 0 if both tables are empty."""
        return self._last("seconds")

    @property
    def frames_per_second(self) -> float:
        """Mean over the whole run, evaluations included; NaN if unknown."""
        return self.frames / self.seconds if self.seconds > 0 else float("nan")

    @property
    def expert_return(self) -> float:
        """Mean task return of its demonstrations; NaN if it has none."""
        returns = self.evaluation.get("expert_task_return_mean", np.zeros(0))
        finite = returns[np.isfinite(returns)]
        return float(finite[-1]) if len(finite) else float("nan")

    @property
    def is_finished(self) -> bool:
        """Whether its last evaluation came after all frames."""
        frames = self.evaluation["frame"]
        return bool(len(frames)) and bool(frames[-1] >= self.config["total_frames"])

    @property
    def state(self) -> str:
        """One of "finished", "unfinished: frame x of y", "empty"."""
        if self.is_finished:
            return "finished"
        if self.frames == 0:
            return "empty"
        total_frames = self.config["total_frames"]
        return f"unfinished: frame {self.frames:,.0f} of {total_frames:,}"

    def _last(self, column: str) -> float:
        both = (self.evaluation, self.training)
        last = [t[column][-1] for t in both if column in t and len(t[column])]
        return float(np.max(last, initial=0.0, where=np.isfinite(last)))


def find(roots: Iterable[pathlib.Path]) -> list[pathlib.Path]:
    """Returns every folder of a run at or below `roots`, each one once.

    That is a folder with a config.json, or with the failed.json that a sweep writes for
    a run that ended before it had one. Links to folders are followed.
    """
    found: dict[pathlib.Path, pathlib.Path] = {}
    for root in roots:
        seen = set()
        for path, folders, files in os.walk(root, followlinks=True):
            folder = pathlib.Path(path)
            if (place := os.path.realpath(path)) in seen:  # links may form a circle
                folders.clear()
                continue
            seen.add(place)
            if "config.json" in files or _FAILED in files:
                found.setdefault(folder.resolve(), folder)
                folders[:] = [name for name in folders if name not in _OWN_FOLDERS]
    return sorted(found.values())


def read(folder: pathlib.Path) -> Run:
    """Reads one run, which may still be training.

    Raises:
      UnreadableError: its config.json is damaged or missing.
    """
    stored = _read_config(folder / "config.json")
    nested = stored["config"]
    defaults = defaults_of(nested["method"], nested["task"])
    config = {name: _setting(nested, name, value) for name, value in defaults.items()}
    remarks: list[str] = []
    if figures.installed(nested["method"]) is None:
        name = nested["method"]
        why = "not installed here"
        if ":" in name and not methods.is_trusted(name):
            why = f"code that only its folder names: --trust={name} imports it"
        remarks.append(f"its method {name!r} is {why}")
        known = {name.split(".")[0] for name in config}
        own = {key: value for key, value in nested.items() if key not in known}
        config |= {key: value for key, value in flat(own).items() if _is_name(key)}
    if (folder / _FAILED).exists():
        remarks.append(f"failed, {_exit_status(folder)}; see its log")
    evaluation = _read_table(folder / "eval.csv", ("frame", _RETURN), remarks)
    if not len(evaluation[_RETURN]) and not any("eval.csv" in r for r in remarks):
        remarks.append("no evaluation yet")
    training = _read_table(folder / "train.csv", ("frame",), remarks)
    return Run(
        folder=folder,
        name=printable(folder),
        config=config,
        variant=figures.variant_of(nested),
        evaluation=evaluation,
        training=training,
        device=str(stored.get("device", "unknown"))[:_MAX_REASON],
        remarks=tuple(remarks),
    )


@functools.cache
def defaults_of(method: str, task: str) -> dict[str, Any]:
    """Returns the paper's settings for a method and task, by dotted name.

    For a method that is not installed, only the settings that all methods have.
    """
    if figures.installed(method) is not None:
        known, names = method, jaxil_config.fields(method)
    else:
        known, names = next(iter(methods.known())), jaxil_config.FIELDS
    config = jaxil_config.defaults(known, task)
    values = {name: jaxil_config.read(config, name) for name in names}
    return as_stored({**values, "method": method})


def printable(path: pathlib.Path) -> str:
    """Returns a path as text that any file can hold and any terminal can show."""
    return errors.printable(path.as_posix().encode(errors="replace").decode(), 4000)


def _read_config(path: pathlib.Path) -> dict[str, Any]:
    try:
        stored = json.loads(untrusted.read_regular(path, _MAX_CONFIG_BYTES))
        # Lone surrogates, which no file can hold, and nesting too deep to walk.
        json.dumps(stored, ensure_ascii=False).encode()
    except OSError as error:
        failed = (path.parent / _FAILED).exists()
        why = f"the run failed, {_exit_status(path.parent)}" if failed else ""
        raise UnreadableError(f"cannot be read ({why or error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise UnreadableError(f"is damaged ({str(error)[:_MAX_REASON]})") from error
    config = stored.get("config") if isinstance(stored, dict) else None
    if not isinstance(config, dict):
        raise UnreadableError('has no "config" with settings in it')
    for field, kind in _NEEDED.items():
        value = config.get(field)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise UnreadableError(f"has no {field} ({_shown(value)})")
        if isinstance(value, str) and not _is_name(value):
            raise UnreadableError(f"has a damaged {field} ({_shown(value)})")
    return stored


def _is_name(text: str) -> bool:
    return text.isprintable() and 0 < len(text) <= _MAX_REASON


def _exit_status(folder: pathlib.Path) -> str:
    status = exit_status(folder)
    return f"exit status {'unknown' if status is None else status}"


def exit_status(folder: pathlib.Path) -> int | None:
    """Returns the exit status of a run that a sweep saw fail; None if unknown."""
    try:
        content = untrusted.read_regular(folder / _FAILED, _MAX_CONFIG_BYTES)
        return int(json.loads(content)["exit_status"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None


def _setting(nested: Mapping[str, Any], field: str, default: Any) -> Any:
    """Returns one setting; refuses text where a number belongs, and so on."""
    value: Any = nested
    for part in field.split("."):
        if not isinstance(value, Mapping):
            raise UnreadableError(f"has a value in place of the section of {field}")
        if part not in value:
            return default  # an older jaxil wrote the file
        value = value[part]
    if _kind(value) != _kind(default):
        rule = f"expected a value such as {default!r}"
        raise UnreadableError(f"has {field}={_shown(value)}; {rule}")
    if _kind(value) is float and not abs(value) <= LARGEST:
        raise UnreadableError(f"has {field}={_shown(value)}, beyond any true value")
    return value


def _kind(value: Any) -> type:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float if is_number else type(value)


def _shown(value: Any) -> str:
    return ascii(value)[:_MAX_REASON]


def _read_table(
    path: pathlib.Path, columns: tuple[str, ...], remarks: list[str]
) -> dict[str, np.ndarray]:
    """Reads a table, and keeps the rows with numbers in `columns`, "frame" among them.

    Adds to `remarks` what is wrong with it.
    """
    empty = {column: np.zeros(0) for column in columns}
    try:
        table = tables.read_csv(path)
        missing = [column for column in columns if column not in table]
        if missing:
            raise ValueError(f"{path}: expected a column {missing[0]}")
    except FileNotFoundError:
        remarks.append(f"no {path.name}")
        return empty
    except OSError as error:
        remarks.append(f"{path.name} cannot be read ({error.strerror})")
        return empty
    except ValueError as error:
        reason = str(error).removeprefix(f"{path}: ")[:_MAX_REASON]
        remarks.append(f"{path.name} is damaged ({reason})")
        return empty
    for values in table.values():
        values[np.abs(values) > LARGEST] = np.nan
    good = np.all([np.isfinite(table[column]) for column in columns], axis=0)
    if not good.all():
        remarks.append(f"{path.name}: {int((~good).sum())} rows without a number")
    # Of several rows of one frame the last counts: a resumed run wrote it again.
    frames = table["frame"][good]
    _, backwards = np.unique(frames[::-1], return_index=True)
    order = len(frames) - 1 - backwards
    return {column: values[good][order] for column, values in table.items()}
