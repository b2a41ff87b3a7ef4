"""Filmed episodes: the video, the rewards under it, and P-SIL's transport plan."""

import functools
import pathlib
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxil.files import archive
from jaxil.reporting import plots
from jaxil.reporting.groups import Group
from jaxil.reporting.results import Study
from jaxil.reporting.runs import Run
from jaxil.reporting.sheets import Panel, Sheet

_NAME = re.compile(r"frame_(\d+)\.mp4")
# Browsers refuse pages of hundreds of megabytes; a suite episode has about one.
_MAX_BYTES_EACH, _MAX_BYTES = 20_000_000, 100_000_000
_STORED = {"imitation_rewards", "task_rewards", "plan"}  # beside a video
_REWARD_HEIGHT, _PLAN_HEIGHT = 1.75, 3.4  # inches


class Episode(NamedTuple):
    """One filmed episode.

    Attributes:
      group: of the run.
      run: whose.
      frame: environment frames of training when it was filmed.
      video: an MP4.
      sheet: rewards, and the plan if there is one; None without them.
    """

    group: Group
    run: Run
    frame: int
    video: bytes
    sheet: Sheet | None


def collect(study: Study, per_group: int) -> tuple[list[Episode], list[str]]:
    """Reads the newest videos of the first seed of each group that has any.

    Args:
      study: all runs.
      per_group: how many, at least 0.

    Returns:
      The episodes, and one sentence for each that was left out.
    """
    episodes: list[Episode] = []
    left_out: list[str] = []
    size = 0
    for group in study.groups:
        films = [(run, _films(run)) for run in group.runs]
        run, paths = next(((r, p) for r, p in films if p), (group.runs[0], []))
        for path in paths[-per_group:] if per_group else []:
            try:
                video = path.read_bytes()
            except OSError as error:
                left_out.append(f"{path} can't be read ({error.strerror})")
                continue
            fault = _fault(video)
            if size + len(video) > _MAX_BYTES:
                fault = f"the page already holds {size / 1e6:.0f} MB of videos"
            if fault is not None:
                left_out.append(f"{path} is left out: {fault}")
                continue
            size += len(video)
            frame = _frame(path)
            name = re.sub(r"\W+", "_", f"{group.task}_{group.label}").strip("_")
            sheet = _sheet(
                path.with_suffix(".npz"),
                f"episode_{name}_seed{run.seed}_frame{frame}",
                study.looks[group.label].colour,
                left_out,
            )
            episodes.append(Episode(group, run, frame, video, sheet))
    return episodes, left_out


def return_at(run: Run, frame: int) -> float:
    """Returns the mean return of the evaluation that was filmed; NaN if not known."""
    there = np.flatnonzero(run.evaluation["frame"] == frame)
    return float(run.returns[there[0]]) if len(there) else float("nan")


def _films(run: Run) -> Sequence[pathlib.Path]:
    paths = [p for p in (run.folder / "videos").glob("*.mp4") if _NAME.match(p.name)]
    return sorted(paths, key=_frame)


def _frame(path: pathlib.Path) -> int:
    match = _NAME.match(path.name)
    return int(match.group(1)) if match else 0


def _fault(video: bytes) -> str | None:
    """Says why this can't be a whole MP4 of sensible size; None if it can."""
    if len(video) > _MAX_BYTES_EACH:
        return f"it has {len(video) / 1e6:.0f} MB"
    if video[4:8] != b"ftyp" or b"moov" not in video or b"mdat" not in video:
        return "it is no whole MP4"
    return None


def _sheet(
    path: pathlib.Path, name: str, colour: str, left_out: list[str]
) -> Sheet | None:
    """Draws what is stored beside a video; None if nothing is."""
    try:
        names = _STORED & archive.member_names(path)
        stored = archive.read_archive(path, max_bytes=dict.fromkeys(names, 2**26))
        arrays = {name: np.asarray(each, np.float64) for name, each in stored.items()}
        imitation = arrays.get("imitation_rewards", np.zeros(0))
        task = arrays.get("task_rewards", np.zeros(0))
        plan = arrays.get("plan", np.zeros((0, 0)))
        if (imitation.ndim, task.ndim, plan.ndim) != (1, 1, 2):
            raise ValueError("wrong number of axes")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        left_out.append(f"{path} is left out: it can't be read ({error})")
        return None
    panels = []
    if np.isfinite(imitation).any():
        if not np.isfinite(task).any():
            task = np.zeros(0)
        draw = functools.partial(
            plots.rewards, imitation=imitation, task=task, colour=colour
        )
        panels.append(Panel("rewards", draw, _REWARD_HEIGHT, plots.REWARD_MARGINS))
    if plan.size:
        draw = functools.partial(plots.plan, weights=plan)
        # Below the rewards, at the same place: one step is one height.
        panels.append(Panel("transport plan", draw, _PLAN_HEIGHT, plots.REWARD_MARGINS))
    return Sheet(name, tuple(panels)) if panels else None
