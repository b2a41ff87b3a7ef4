"""Filmed episodes: the video, the rewards under it, and P-SIL's transport plan."""

import functools
import pathlib
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxil.files import archive, untrusted
from jaxil.reporting import plots
from jaxil.reporting.groups import Group
from jaxil.reporting.runs import LARGEST, Run, printable
from jaxil.reporting.sheets import Panel, Sheet

_NAME = re.compile(r"frame_(\d{1,12})\.mp4")
# Browsers refuse pages of hundreds of megabytes; a suite episode has about one.
_MAX_BYTES_EACH, _MAX_BYTES = 20_000_000, 100_000_000
# What may be stored beside a video, and how many axes it has.
_NUM_AXES = {
    "imitation_rewards": 1,
    "task_rewards": 1,
    "plan": 2,
    "step_seconds": 0,
    "agent_strip": 4,
    "expert_strip": 4,
}
_MAX_ARRAY_BYTES, _MAX_STEPS = 2**26, 100_000
_REWARD_HEIGHT, _PLAN_HEIGHT, _ALIGNMENT_HEIGHT = 1.75, 3.4, 2.6  # inches


class Episode(NamedTuple):
    """One filmed episode."""

    group: Group
    run: Run  # of the group
    frame: int  # environment frames of training when it was filmed
    video: bytes  # an MP4
    sheet: Sheet | None  # rewards, plan and alignment, as far as they are there

    @property
    def about(self) -> str:
        """Which episode it is, and the mean return of its evaluation."""
        parts = [f"seed {self.run.seed}, after {self.frame:,} frames"]
        here = self.run.returns[self.run.evaluation["frame"] == self.frame]
        if len(here):
            parts.append(f"mean return of this evaluation: {here[0]:.0f}")
        if np.isfinite(self.run.expert_return):
            parts.append(f"expert: {self.run.expert_return:.0f}")
        return "; ".join(parts)


def collect(groups: Sequence[Group], per_group: int) -> tuple[list[Episode], list[str]]:
    """Reads the newest videos of the first seed of each group that has any.

    Returns:
      The episodes, and one sentence for each that was left out.
    """
    episodes: list[Episode] = []
    left_out: list[str] = []
    room = _MAX_BYTES
    for group in groups if per_group else []:  # [-0:] would be all
        run = next(filter(_videos, group.runs), group.runs[0])
        for path in _videos(run)[-per_group:]:
            try:
                video = _read_video(path, room)
            except (OSError, ValueError) as error:
                left_out.append(_fault(path, error))
                continue
            room -= len(video)
            name = f"episode{len(episodes) + 1}_{group.task}_{group.variant.slug}"
            name = re.sub(r"\W+", "_", name, flags=re.ASCII)[:100]
            stored, sheet = path.with_suffix(".npz"), None
            try:
                if stored.exists():
                    sheet = _sheet(stored, name, group.look.colour)
            except (OSError, ValueError, TypeError) as error:
                left_out.append(_fault(stored, error))
            episodes.append(Episode(group, run, _frame(path), video, sheet))
    return episodes, left_out


def _fault(path: pathlib.Path, error: Exception) -> str:
    reason = str(error)
    if isinstance(error, OSError):
        reason = f"cannot be read ({error.strerror})"
    return f"{printable(path)} is left out: it {reason}"


def _videos(run: Run) -> Sequence[pathlib.Path]:
    found = (run.folder / "videos").glob("*.mp4")
    return sorted((path for path in found if _NAME.fullmatch(path.name)), key=_frame)


def _frame(path: pathlib.Path) -> int:
    return int(path.stem.removeprefix("frame_"))


def _read_video(path: pathlib.Path, room: int) -> bytes:
    """Returns a whole MP4.

    Raises:
      OSError: it cannot be read.
      ValueError: it is too large or no MP4; continues a sentence about it.
    """
    with untrusted.open_regular(path) as file:
        video = file.read(_MAX_BYTES_EACH + 1)
    if len(video) > _MAX_BYTES_EACH:
        raise ValueError(f"has more than {_MAX_BYTES_EACH // 10**6} MB")
    if len(video) > room:
        raise ValueError(f"would exceed the page's {_MAX_BYTES // 10**6} MB of videos")
    if video[4:8] != b"ftyp" or b"moov" not in video or b"mdat" not in video:
        raise ValueError("is not a whole MP4")
    return video


def _sheet(path: pathlib.Path, name: str, colour: str) -> Sheet | None:
    """Plots what is stored beside a video; None if there is nothing to plot.

    Raises:
      OSError: the file cannot be read.
      ValueError, TypeError: it is damaged; continues a sentence about it.
    """
    names = _NUM_AXES.keys() & archive.member_names(path)
    limits = dict.fromkeys(names, _MAX_ARRAY_BYTES)
    filmed = plots.Filmed(**_arrays(archive.read_archive(path, max_bytes=limits)))
    panels = []
    margins = plots.REWARD_MARGINS  # of all, so that their times line up
    if np.isfinite(filmed.imitation_rewards).any():
        draw = functools.partial(plots.rewards, filmed=filmed, colour=colour)
        panels.append(Panel("rewards", draw, _REWARD_HEIGHT, margins))
    if filmed.plan.any():
        draw = functools.partial(plots.plan, filmed=filmed)
        panels.append(Panel("transport plan", draw, _PLAN_HEIGHT, margins))
        if filmed.agent_strip.size and filmed.expert_strip.size:
            draw = functools.partial(plots.alignment, filmed=filmed)
            panels.append(Panel("alignment", draw, _ALIGNMENT_HEIGHT, margins))
    return Sheet(name, tuple(panels)) if panels else None


def _arrays(stored: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the arrays of an archive, checked; strips uint8, all others float64.

    Raises:
      ValueError: training writes no such array.
    """
    for name, array in stored.items():
        if array.dtype.kind not in "fiub":
            raise ValueError("has arrays that are not of real numbers")
        if array.ndim != _NUM_AXES[name]:
            raise ValueError(f"has an array {name} of {array.ndim} axes")
        if max(array.shape, default=0) > _MAX_STEPS:
            raise ValueError(f"has an array {name} of more than {_MAX_STEPS} steps")
        if array.ndim == 4:
            if array.dtype != np.uint8 or array.shape[-1] != 3 or not array.size:
                raise ValueError(f"has an array {name} that is no film strip")
            continue
        stored[name] = array.astype(np.float64)
        if (np.abs(stored[name]) > LARGEST).any():
            raise ValueError(f"has an array {name} with numbers beyond any reward")
    if not stored.get("step_seconds", 0.0) >= 0:  # nor NaN
        raise ValueError("has an array step_seconds that is no duration")
    if "plan" in stored:
        stored["plan"] = np.clip(np.nan_to_num(stored["plan"]), 0.0, None)
    return stored
