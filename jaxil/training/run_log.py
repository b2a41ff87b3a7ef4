"""What a run writes for its user: tables, events, learning curve, videos."""

import contextlib
import io
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxil import methods
from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.errors import MethodError
from jaxil.files import video
from jaxil.files.tables import CsvLog
from jaxil.files.writing import write_atomically
from jaxil.machine.screen import say
from jaxil.training import learning_curve, loggers
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
        """Opens the tables and loggers.

        Args:
          workdir: the run's folder.
          config: of the run.
          demonstrations: what the method imitates, or None.
          resume_frame: on a resume, rows of later frames are dropped.
          owes_evaluation: whether the evaluation at that frame will be played again.

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
        self._last = (0, 0.0)  # frame and seconds of the last row
        self._speed = 0.0

    def episode(
        self, frame: int, seconds: float, episode: int, values: Mapping[str, Any]
    ) -> None:
        """Logs a training episode; `values` are the columns from `task_return` on."""
        last_frame, last_seconds = self._last
        if frame > last_frame:  # else it ended in the same round as the one before
            self._speed = (frame - last_frame) / max(seconds - last_seconds, 1e-9)
            self._last = (frame, seconds)
        row = {"frames_per_second": round(self._speed, 2), **values}
        self._write_training(frame, seconds, episode, row)

    def updates(self, *, frame: int, seconds: float, metrics: dict[str, float]) -> None:
        """Logs the progress of a method that plays no episodes."""
        self._write_training(frame, seconds, 0, metrics)

    def evaluation(
        self,
        result: Result,
        frame: int,
        seconds: float,
        episode: int,
        *,
        pre_tanh: float,
    ) -> str:
        """Logs an evaluation, with learning curve and video.

        Args:
          result: what was played, and its video.
          frame: of the run.
          seconds: of the run.
          episode: training episodes so far.
          pre_tanh: the actor's mean |pre-tanh|; NaN before the first update.

        Returns:
          A line for the terminal.
        """
        evaluation = result.evaluation
        row: dict[str, Any] = {
            "seconds": round(seconds, 3),
            "episode": episode,
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
            self._write_scalars("eval", frame, row)
            learning_curve.plot(
                self._workdir / "learning_curve.png",
                self._workdir / "eval.csv",
                title=f"{config.method} on {config.task}, seed {config.seed}",
                expert_return=self._expert_return,
            )
            if result.sides:
                self._write_video(result, frame)
        line = (
            f"frame {frame}: task return {evaluation.mean:.1f} ± {evaluation.std:.1f}"
        )
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

    def _write_training(
        self, frame: int, seconds: float, episode: int, values: Mapping[str, Any]
    ) -> None:
        unknown = sorted(set(values) - {*TRAIN_COLUMNS, *self._metrics})
        if unknown:
            raise MethodError(
                f"{self._config.method} returns metrics that it does not declare: "
                f"{', '.join(unknown)}; name them in METHOD.metrics"
            )
        row = {"seconds": round(seconds, 3), "episode": episode, **values}
        with writes_to(self._workdir):
            self._write_scalars("train", frame, row)

    def _write_scalars(self, group: str, frame: int, row: Mapping[str, Any]) -> None:
        self._tables[group].append({"frame": frame, **row})
        for logger in self._loggers:
            logger.write_scalars(group, frame, row)

    def _write_video(self, result: Result, frame: int) -> None:
        folder = self._workdir / "videos"
        folder.mkdir(exist_ok=True)
        packed = io.BytesIO()
        np.savez_compressed(packed, **result.filmed)  # pyright: ignore[reportArgumentType]
        write_atomically(folder / f"frame_{frame:09d}.npz", packed.getvalue())
        frames, captions = zip(*result.sides)
        path = folder / f"frame_{frame:09d}.mp4"
        fps = frames_per_second(len(frames[0]))
        video.write_video(path, *frames, fps=fps, labels=captions)
        for logger in self._loggers:
            logger.write_video(frame, path)


def as_floats(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Returns metrics as numbers, fetched from the device."""
    return {name: float(value) for name, value in metrics.items()}


def frames_per_second(num_images: int) -> float:
    """Returns the frame rate at which an episode plays in ten seconds or less.

    Suite episodes last 10 to 25 simulated seconds. Both halves of a video play at the
    rate of the agent's, so they stay together.
    """
    return max(15.0, num_images / 10.0)
