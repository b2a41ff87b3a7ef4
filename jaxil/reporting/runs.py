"""Finding runs and reading what they wrote, however little that is."""

import functools
import json
import os
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxil import config as jaxil_config
from jaxil.files import tables
from jaxil.files.settings import as_stored, flat
from jaxil.reporting import figures

# Large folders of a run in which no other run can be.
_OWN_FOLDERS = ("checkpoints", "replay", "tensorboard", "videos")
_RETURN = "task_return_mean"
_FAILED = "failed.json"  # of launch/sweep.py
# What a run of this jaxil writes; anything else is a damaged file.
_NEEDED = {"method": str, "task": str, "seed": int, "total_frames": int}

Table = Mapping[str, np.ndarray]


class UnreadableError(Exception):
    """A config.json that is not that of a run; the message says why."""


class Run(NamedTuple):
    """One run as its folder shows it.

    Attributes:
      folder: where it is.
      name: the folder as people call it.
      config: every setting by its dotted name; what the file lacks has its default.
      variant: its method with what an ablation changed.
      evaluation: eval.csv by column, rising frames, finite returns. Shapes [E].
      training: train.csv by column, rising frames. Shapes [R].
      device: what it computed on.
      remarks: what is missing or odd, one sentence each.
    """

    folder: pathlib.Path
    name: str
    config: Mapping[str, Any]
    variant: figures.Variant
    evaluation: Table
    training: Table
    device: str
    remarks: tuple[str, ...]

    @property
    def task(self) -> str:
        """The task, such as "walker_walk"."""
        return self.config["task"]

    @property
    def seed(self) -> int:
        """The seed."""
        return self.config["seed"]

    @property
    def total_frames(self) -> int:
        """Environment frames that it was asked for."""
        return self.config["total_frames"]

    @property
    def returns(self) -> np.ndarray:
        """Mean task return of each evaluation. Shape [E]."""
        return self.evaluation[_RETURN]

    @property
    def frames(self) -> float:
        """Environment frames so far, by either table; 0 if both are empty."""
        return max(self._last("frame"), 0.0)

    @property
    def seconds(self) -> float:
        """Seconds so far; 0 if both tables are empty."""
        return max(self._last("seconds"), 0.0)

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
        return bool(len(self.returns)) and bool(
            self.evaluation["frame"][-1] >= self.total_frames
        )

    @property
    def state(self) -> str:
        """One of "finished", "unfinished: frame x of y", "empty"."""
        if self.is_finished:
            return "finished"
        if self.frames == 0:
            return "empty"
        return f"unfinished: frame {self.frames:,.0f} of {self.total_frames:,}"

    def _last(self, column: str) -> float:
        tables = (self.evaluation, self.training)
        last = [t[column][-1] for t in tables if column in t and len(t[column])]
        return float(np.max(last, initial=-np.inf, where=np.isfinite(last)))


def find(roots: Iterable[pathlib.Path]) -> list[pathlib.Path]:
    """Returns every folder of a run at or below `roots`, each one once.

    That is a folder with a config.json, or with the failed.json that a sweep writes for
    a run that ended before it had one.

    Args:
      roots: folders that exist.
    """
    found: dict[pathlib.Path, pathlib.Path] = {}
    for root in roots:
        for path, folders, files in os.walk(root):
            folder = pathlib.Path(path)
            if "config.json" in files or _FAILED in files:
                found.setdefault(folder.resolve(), folder)
                folders[:] = [name for name in folders if name not in _OWN_FOLDERS]
    return sorted(found.values())


def read(folder: pathlib.Path) -> Run:
    """Reads one run, which may be going on.

    Raises:
      UnreadableError: its config.json is none.
    """
    stored = _read_config(folder / "config.json")
    nested, device = stored["config"], str(stored.get("device", "unknown"))
    remarks: list[str] = []
    if (folder / _FAILED).exists():
        remarks.append(f"failed, {_exit_status(folder)}; its log says why")
    evaluation = _read_table(folder / "eval.csv", _RETURN, remarks)
    if not len(evaluation[_RETURN]) and not any("eval.csv" in r for r in remarks):
        remarks.append("no evaluation yet")
    training = _read_table(folder / "train.csv", None, remarks)
    return Run(
        folder=folder,
        name=folder.as_posix(),
        config={**_defaults(nested["method"], nested["task"]), **flat(nested)},
        variant=figures.variant_of(nested),
        evaluation=evaluation,
        training=training,
        device=device,
        remarks=tuple(remarks),
    )


def paper_settings(run: Run) -> dict[str, Any]:
    """Returns the paper's settings for a run's method and task, by dotted names."""
    return _defaults(run.config["method"], run.task)


@functools.cache
def _defaults(method: str, task: str) -> dict[str, Any]:
    return flat(as_stored(jaxil_config.default_config(method, task).to_dict()))


def _read_config(path: pathlib.Path) -> dict[str, Any]:
    try:
        stored = json.loads(path.read_text())
    except OSError as error:
        failed = (path.parent / _FAILED).exists()
        why = f"the run failed, {_exit_status(path.parent)}" if failed else ""
        why = why or str(error.strerror)
        raise UnreadableError(f"can't be read ({why})") from error
    except (ValueError, RecursionError) as error:
        raise UnreadableError(f"is damaged ({error})") from error
    config = stored.get("config") if isinstance(stored, dict) else None
    if not isinstance(config, dict):
        raise UnreadableError('has no "config" with settings in it')
    for field, kind in _NEEDED.items():
        value = config.get(field)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise UnreadableError(f"has no {field} ({value!r})")
    if config["method"] not in figures.METHOD_NAMES:
        known = ", ".join(figures.METHOD_NAMES)
        raise UnreadableError(f"method={config['method']!r} is none of {known}")
    for field, value in _defaults(config["method"], config["task"]).items():
        _check_kind(config, field, value)
    return stored


def _exit_status(folder: pathlib.Path) -> str:
    try:
        status = json.loads((folder / _FAILED).read_text())["exit_status"]
    except (OSError, ValueError, KeyError, TypeError):
        status = "unknown"
    return f"exit status {status}"


def _check_kind(config: Mapping[str, Any], field: str, default: Any) -> None:
    """Refuses text where a number belongs, a number where a group does, and so on."""
    value: Any = config
    for part in field.split("."):
        if not isinstance(value, Mapping):
            raise UnreadableError(f"{field} must lie in a group of settings")
        if part not in value:
            return  # an older jaxil wrote the file
        value = value[part]
    if _kind(value) != _kind(default):
        raise UnreadableError(f"{field}={value!r} must be of the kind of {default!r}")


def _kind(value: Any) -> type:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float if is_number else type(value)


def _read_table(
    path: pathlib.Path, needed: str | None, remarks: list[str]
) -> dict[str, np.ndarray]:
    """Reads eval.csv or train.csv; says in `remarks` why it can't."""
    columns = ["frame", *([needed] if needed else [])]
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
        remarks.append(f"{path.name} can't be read ({error.strerror})")
        return empty
    except ValueError as error:
        reason = str(error).removeprefix(f"{path}: ")
        remarks.append(f"{path.name} is damaged ({reason})")
        return empty
    good = np.all([np.isfinite(table[column]) for column in columns], axis=0)
    if not good.all():
        remarks.append(f"{path.name}: {int((~good).sum())} rows without a number")
    # The last row of a frame counts: that is what a resumed run wrote anew.
    frames = table["frame"][good]
    _, backwards = np.unique(frames[::-1], return_index=True)
    order = len(frames) - 1 - backwards
    return {column: values[good][order] for column, values in table.items()}
