"""Where a run's numbers and videos go: tables, TensorBoard, W&B, or a user's own."""

import contextlib
import importlib.metadata
import math
import os
import pathlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from jaxil import outside
from jaxil.config import Config
from jaxil.errors import Fault, UsageError

_WANDB = "wandb"
Values = Mapping[str, float]  # by column of train.csv or eval.csv


class Logger(Protocol):
    """What `--config.logger=package.module:function` returns.

    The function is called with the run's folder, its config as a dict, and the frame
    from which the run resumes, or None. Rows of later frames were lost in a kill, and
    are about to be written again.
    """

    def write_scalars(self, group: str, frame: int, values: Values) -> None:
        """Writes one row, which is NaN where nothing is known yet.

        Args:
          group: "train", at each episode's end, or "eval".
          frame: environment frames so far; never decreases.
          values: by column.
        """
        ...

    def write_video(self, frame: int, path: pathlib.Path) -> None:
        """Takes an evaluation's video, which the run has written to `path`."""
        ...

    def close(self) -> None:
        """Ends the log of a run that is finished or stopped, or has failed."""
        ...


def problems(name: str) -> list[Fault]:
    """Returns why a run cannot have the logger of its config."""
    if not name:
        return []
    try:
        if ":" in name:
            outside.load(name, "logger")
        elif name == _WANDB:
            importlib.metadata.version(_WANDB)
        else:
            rule = "must be wandb or package.module:function"
            return [Fault("logger", rule, value=name)]
    except UsageError as error:
        return [fault for fault in error.faults if isinstance(fault, Fault)]
    except importlib.metadata.PackageNotFoundError:
        rule = "needs Weights & Biases, which is not installed"
        way_out = "pip install wandb, or in jaxil's folder: pip install '.[wandb]'"
        return [Fault("logger", rule, way_out, name)]
    return []


def make(
    config: Config, workdir: pathlib.Path, resume_frame: int | None
) -> list[Logger]:
    """Returns the loggers that a run has beside its tables.

    Raises:
      UsageError: W&B does not accept the run.
    """
    chosen: list[Callable[..., Logger]] = [TensorBoard]
    if config.logger == _WANDB:
        chosen.append(WeightsAndBiases)
    elif config.logger:
        chosen.append(outside.load(config.logger, "logger"))
    return [each(workdir, config.to_dict(), resume_frame) for each in chosen]


class TensorBoard:
    """An events file; TensorBoard drops what a resumed run is about to write again."""

    def __init__(
        self, workdir: pathlib.Path, config: dict[str, Any], resume_frame: int | None
    ) -> None:
        from tensorboardX import event_file_writer  # slow to import
        from tensorboardX.proto import event_pb2

        del config
        messages: Any = event_pb2  # whose classes are made at run time
        folder = workdir / "tensorboard"
        folder.mkdir(exist_ok=True)
        # Not its SummaryWriter: on a full disk its thread dies, and the program then
        # waits for it forever.
        self._writer = event_file_writer.EventsWriter(str(folder / "events"))
        self._event = messages.Event
        if resume_frame is not None:
            start = messages.SessionLog(status=messages.SessionLog.START)
            self._write(step=resume_frame + 1, session_log=start)

    def write_scalars(self, group: str, frame: int, values: Values) -> None:
        scalars = _known(group, values).items()
        summary = [{"tag": tag, "simple_value": value} for tag, value in scalars]
        self._write(step=frame, summary={"value": summary})

    def write_video(self, frame: int, path: pathlib.Path) -> None:
        pass  # it shows no mp4

    def close(self) -> None:
        self._writer.close()

    def _write(self, **fields: Any) -> None:
        self._writer.write_event(self._event(wall_time=time.time(), **fields))
        self._writer.flush()


class WeightsAndBiases:
    """A run of W&B whose steps are frames; offline unless WANDB_MODE says otherwise.

    A resumed run has the same id, so `wandb sync WORKDIR/wandb/offline-run-*` uploads
    all its parts as one run.
    """

    def __init__(
        self, workdir: pathlib.Path, config: dict[str, Any], resume_frame: int | None
    ) -> None:
        import wandb

        wandb_api: Any = wandb
        before = sorted(workdir.glob("wandb/*run-*-*")) if resume_frame else []
        with _no_questions():
            try:
                self._run = wandb_api.init(
                    dir=workdir,
                    project=os.environ.get("WANDB_PROJECT", "jaxil"),
                    name=f"{config['method']} on {config['task']}, "
                    f"seed {config['seed']}",
                    id=before[-1].name.rpartition("-")[2] if before else None,
                    resume="allow" if before else None,
                    mode=os.environ.get("WANDB_MODE", "offline"),
                    config=config,
                    settings=wandb_api.Settings(console="off", silent=True),
                )
            except wandb_api.Error as error:
                way_out = "`wandb login` first, or unset WANDB_MODE to log offline"
                rule = f"does not start ({error})"
                raise UsageError(Fault("logger", rule, way_out, _WANDB)) from error
        self._video = wandb_api.Video

    def write_scalars(self, group: str, frame: int, values: Values) -> None:
        self._run.log(_known(group, values), step=frame)

    def write_video(self, frame: int, path: pathlib.Path) -> None:
        self._run.log({"video": self._video(str(path), format="mp4")}, step=frame)

    def close(self) -> None:
        """Marks the run as finished, or as failed if it is closed by an error."""
        self._run.finish(exit_code=int(sys.exc_info()[0] is not None))


def _known(group: str, values: Values) -> dict[str, float]:
    """Returns values by GROUP/COLUMN, without metrics that have no value yet."""
    return {
        f"{group}/{column}": float(value)
        for column, value in values.items()
        if math.isfinite(value)
    }


@contextlib.contextmanager
def _no_questions() -> Iterator[None]:
    """Hides standard input: W&B then fails instead of asking for a login."""
    terminal = sys.stdin
    with pathlib.Path(os.devnull).open() as sys.stdin:
        try:
            yield
        finally:
            sys.stdin = terminal
