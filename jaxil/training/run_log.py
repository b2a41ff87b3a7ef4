"""What a run writes for its user: tables, events, learning curve, videos."""

import contextlib
import io
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxil import methods
from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.errors import MethodError
from jaxil.files.tables import CsvLog
from jaxil.files.writing import write_atomically
from jaxil.machine.screen import say
from jaxil.training import film, learning_curve, loggers
from jaxil.training.evaluator import Result
from jaxil.training.workdir import writes_to

TRAIN_COLUMNS = (
    "frame",  # environment frames when the episode ended
    "seconds",  # of the run, earlier processes included
    "episode",
    "task_return",  # undiscounted sum of task rewards, which the agent never sees
    "imitation_return",  # the same of the rewards that it learns from
    "length",  # agent steps
    "frames_per_second",  # since a row of an earlier frame; in the first, since frame 0
    "reward_seconds",  # spent on rewards so far, by this process
    # Diagnostics of the learner; those of the method follow.
    "critic/loss",
    "critic/value",
    "critic/target",
    "batch/reward",
    "replay/reward",
    "actor/loss",
    "actor/pre_tanh",
    "exploration_std",
)
EVAL_COLUMNS = (
    "frame",
    "seconds",
    "episode",  # training episodes so far
    "task_return_mean",
    "task_return_std",
    "expert_task_return_mean",
    "wasserstein_to_expert",  # relative to a random policy's
    "actor_pre_tanh",
)
# Beyond this mean |pre-tanh|, the gradient of tanh is below 1 %.
_SATURATED = 3.0


class When(NamedTuple):
    """The first columns of both tables."""

    frame: int
    seconds: float
    episode: int  # training episodes so far


class RunLog:
    """Owns what a run writes beside its checkpoints.

    All methods raise RunFolderError if a file cannot be written.
    """

    def __init__(
        self,
        workdir: pathlib.Path,
        config: Config,
        demonstrations: loading.Demonstrations | None,
        resume_frame: int | None,
        *,
        owes_evaluation: bool = False,
    ) -> None:
        """Opens the tables and loggers in the run's folder.

        On a resume, rows of frames after `resume_frame` are dropped, and that of an
        evaluation at that frame if it will be played again.

        Raises:
          UsageError: the config's logger does not start.
        """
        self._workdir = workdir
        self._config = config
        own = self._metrics = methods.get(config.method).metrics
        evaluated = resume_frame
        if evaluated is not None and owes_evaluation:
            evaluated -= 1
        with writes_to(workdir):
            self._tables = {
                name: CsvLog(
                    workdir / f"{name}.csv",
                    columns,
                    resume_frame=frame,
                    # Rows after it mean a checkpoint, which was deleted since.
                    kept_from=config.checkpoint_every_frames,
                    say=say,
                )
                for name, columns, frame in (
                    ("train", (*TRAIN_COLUMNS, *own), resume_frame),
                    ("eval", EVAL_COLUMNS, evaluated),
                )
            }
            self._loggers = loggers.make(config, workdir, resume_frame)
        self._expert_return: float | None = None
        if demonstrations is not None:
            self._expert_return = demonstrations.mean_return()
        self._last = When(0, 0.0, 0)  # of the last row of an earlier frame
        self._speed = 0.0

    def episode(self, when: When, values: Mapping[str, Any]) -> None:
        """Logs a training episode; `values` are the columns from `task_return` on.

        Raises:
          MethodError: the method does not declare all of its metrics.
        """
        frames, seconds = when.frame - self._last.frame, when.seconds
        if frames > 0:  # else it ended in the same round as the one before
            self._speed = frames / max(seconds - self._last.seconds, 1e-9)
            self._last = when
        self._training(when, {"frames_per_second": round(self._speed, 2), **values})

    def updates(self, when: When, values: Mapping[str, Any]) -> None:
        """Logs the metrics of a method that plays no episodes; see `episode`."""
        self._training(when, values)

    def _training(self, when: When, values: Mapping[str, Any]) -> None:
        unknown = sorted(set(values) - {*TRAIN_COLUMNS, *self._metrics})
        if unknown:
            raise MethodError(
                f"{self._config.method} returns metrics that it does not declare: "
                f"{', '.join(unknown)}; name them in METHOD.metrics"
            )
        with writes_to(self._workdir):
            self._write_row("train", when, values)

    def evaluation(self, when: When, result: Result, pre_tanh: float) -> str:
        """Logs an evaluation, with learning curve and video.

        `pre_tanh` is the actor's mean |pre-tanh|, NaN before the first update. Returns
        a line for the terminal.
        """
        evaluation = result.evaluation
        row: dict[str, Any] = {
            "task_return_mean": evaluation.mean,
            "task_return_std": evaluation.std,
            "actor_pre_tanh": pre_tanh,
        }
        if self._expert_return is not None:
            row["expert_task_return_mean"] = self._expert_return
        if result.distance is not None:
            row["wasserstein_to_expert"] = result.distance
        config = self._config
        with writes_to(self._workdir):
            self._write_row("eval", when, row)
            learning_curve.plot(
                self._workdir / "learning_curve.png",
                self._workdir / "eval.csv",
                title=f"{config.method} on {config.task}, seed {config.seed}",
                expert_return=self._expert_return,
            )
            if result.sides:
                self._write_video(when.frame, result)
        mean, std = evaluation.mean, evaluation.std
        line = f"frame {when.frame}: task return {mean:.1f} ± {std:.1f}"
        if self._expert_return is not None:
            line += f", the expert's {self._expert_return:.1f}"
        if pre_tanh > _SATURATED:
            line += (
                f"; the actor saturates (mean |pre-tanh| {pre_tanh:.1f}): raise "
                "pre_tanh_penalty if the return stays flat"
            )
        return line

    def close(self) -> None:
        """Closes the loggers, all of them even if one fails."""
        with writes_to(self._workdir), contextlib.ExitStack() as closing:
            for logger in self._loggers:
                closing.callback(logger.close)

    def _write_row(self, group: str, when: When, values: Mapping[str, Any]) -> None:
        row = {"seconds": round(when.seconds, 3), "episode": when.episode, **values}
        self._tables[group].append({"frame": when.frame, **row})
        for logger in self._loggers:
            logger.write_scalars(group, when.frame, row)

    def _write_video(self, frame: int, result: Result) -> None:
        folder = self._workdir / "videos"
        folder.mkdir(exist_ok=True)
        packed = io.BytesIO()
        np.savez_compressed(packed, **result.filmed)  # pyright: ignore[reportArgumentType]
        write_atomically(folder / f"frame_{frame:09d}.npz", packed.getvalue())
        path = folder / f"frame_{frame:09d}.mp4"
        film.write(path, result.sides)
        for logger in self._loggers:
            logger.write_video(frame, path)


def as_floats(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Returns metrics as numbers, fetched from the device."""
    return {name: float(value) for name, value in metrics.items()}
