"""What a run shows of itself: tables, events, learning curve, videos."""

import io
import pathlib
from typing import Any

import numpy as np

from jaxil import methods
from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.environments.evaluation import Evaluation
from jaxil.files import metrics, video

# The learner's diagnostics in train.csv; the method's own follow.
LEARNER_COLUMNS = (
    "critic/loss",
    "critic/value",
    "critic/target",
    "batch/reward",
    "replay/reward",
    "actor/loss",
    "actor/pre_tanh",
    "exploration_std",
)
# Beyond this mean |pre-tanh|, the gradient of tanh is below 1 %.
_SATURATED = 3.0


class Outputs:
    """Owns what a run writes beside its checkpoints."""

    def __init__(
        self,
        workdir: pathlib.Path,
        config: Config,
        demonstrations: loading.Demonstrations | None,
        resume_frame: int | None,
    ) -> None:
        """Opens the tables; on a resume, rows after `resume_frame` are dropped."""
        self._workdir = workdir
        self._config = config
        self._metrics = metrics.Metrics(
            workdir,
            resume_frame=resume_frame,
            extra_train_columns=(
                "reward_seconds",
                *LEARNER_COLUMNS,
                *methods.get(config.method).metrics,
            ),
            extra_eval_columns=("actor_pre_tanh",),
        )
        self._expert_frames: np.ndarray | None = None
        self._expert_return: float | None = None
        if demonstrations is not None:
            self._expert_return = demonstrations.mean_return()
            if demonstrations.frames.ndim == 5:
                self._expert_frames = demonstrations.frames[0]
        self._pre_tanh = float("nan")
        self._last: tuple[int, float] | None = None

    def episode(
        self,
        *,
        frame: int,
        seconds: float,
        episode: int,
        task_return: float,
        imitation_return: float,
        length: int,
        reward_seconds: float,
        metrics: dict[str, float],
    ) -> None:
        """Writes one training episode down."""
        last_frame, last_seconds = self._last or (0, 0.0)
        speed = (frame - last_frame) / max(seconds - last_seconds, 1e-9)
        self._last = (frame, seconds)
        self._pre_tanh = metrics.get("actor/pre_tanh", self._pre_tanh)
        self._metrics.train(
            {
                "frame": frame,
                "seconds": round(seconds, 3),
                "episode": episode,
                "task_return": task_return,
                "imitation_return": imitation_return,
                "length": length,
                "frames_per_second": round(speed, 2),
                "reward_seconds": round(reward_seconds, 3),
                **metrics,
            }
        )

    def updates(self, *, frame: int, seconds: float, metrics: dict[str, float]) -> None:
        """Writes a method's progress down that plays no episodes."""
        self._pre_tanh = metrics.get("actor/pre_tanh", self._pre_tanh)
        self._metrics.train(
            {"frame": frame, "seconds": round(seconds, 3), "episode": 0, **metrics}
        )

    def evaluation(
        self,
        evaluation: Evaluation,
        frame: int,
        seconds: float,
        episode: int,
        *,
        distance: float | None,
        filmed: dict[str, np.ndarray],
    ) -> str:
        """Writes one evaluation down, with picture and video.

        Args:
          evaluation: what was played.
          frame: of the run.
          seconds: of the run.
          episode: training episodes so far.
          distance: to the expert, relative to a random policy; None if unknown.
          filmed: arrays to keep beside the video, see `train.Run.explain`.

        Returns:
          One line for people.
        """
        row: dict[str, Any] = {
            "frame": frame,
            "seconds": round(seconds, 3),
            "episode": episode,
            "task_return_mean": evaluation.mean,
            "task_return_std": evaluation.std,
            "actor_pre_tanh": self._pre_tanh,
        }
        if self._expert_return is not None:
            row["expert_task_return_mean"] = self._expert_return
        if distance is not None:
            row["wasserstein_to_expert"] = distance
        self._metrics.evaluation(row)
        metrics.write_learning_curve(
            self._workdir / "learning_curve.png",
            self._workdir / "eval.csv",
            title=f"{self._config.method} on {self._config.task}, "
            f"seed {self._config.seed}",
            expert_return=self._expert_return,
        )
        if evaluation.video is not None:
            self._write_video(evaluation.video, filmed, frame)
        line = (
            f"frame {frame}: task return {evaluation.mean:.1f} ± {evaluation.std:.1f}"
        )
        if self._expert_return is not None:
            line += f", the expert's {self._expert_return:.1f}"
        if self._pre_tanh > _SATURATED:
            line += (
                f"; the actor saturates (mean |pre-tanh| {self._pre_tanh:.1f}): raise "
                "pre_tanh_penalty if the return stays flat"
            )
        return line

    def close(self) -> None:
        """Flushes and closes the tables."""
        self._metrics.close()

    def _write_video(
        self, agent_frames: np.ndarray, filmed: dict[str, np.ndarray], frame: int
    ) -> None:
        folder = self._workdir / "videos"
        folder.mkdir(exist_ok=True)
        packed = io.BytesIO()
        np.savez_compressed(packed, **filmed)  # pyright: ignore[reportArgumentType]
        metrics.write_atomically(folder / f"frame_{frame:09d}.npz", packed.getvalue())
        video.write_video(
            folder / f"frame_{frame:09d}.mp4",
            agent_frames,
            self._expert_frames,
            fps=frames_per_second(len(agent_frames)),
        )


def frames_per_second(num_images: int) -> float:
    """Returns the speed at which an episode plays in ten seconds or less.

    Suite episodes last 10 to 25 simulated seconds; one speed for all keeps the two
    halves of a video together.
    """
    return max(15.0, num_images / 10.0)
