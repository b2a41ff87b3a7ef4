"""Shows a demonstration file as a table, a contact sheet and a video."""

import itertools
import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from jaxil.demonstrations import foreign, rendering, states
from jaxil.demonstrations.readers.recording import PixelEpisode, Recording
from jaxil.environments import suite
from jaxil.files.untrusted import printable

NUM_COLUMNS = 8  # pictures of an episode on the sheet
_NUM_ROWS = 10  # episodes on the sheet
_MIN_SIDE = 96  # pixels of a picture on the sheet
_MARGIN = 4
_CAPTION = 16
_DEFAULT_SPEED = 25.0  # frames per second, where a file lacks it


class EpisodeSummary(NamedTuple):
    """One row of the table.

    Attributes:
      num_frames: N + 1.
      size: of a frame in pixels, "WxH"; "rendered" for states.
      action_dim: None without actions.
      task_return: None without rewards.
    """

    num_frames: int
    size: str
    action_dim: int | None
    task_return: float | None


class Inspection(NamedTuple):
    """The content of a file.

    Attributes:
      facts: label and text of what the file says of itself.
      episodes: one summary each.
      pictures: of up to ten episodes, uint8 [8, H, W, 3] each, evenly spaced in time.
      video: the first episode, uint8 [N + 1, H, W, 3].
      frames_per_second: of the video.
    """

    facts: dict[str, str]
    episodes: list[EpisodeSummary]
    pictures: list[np.ndarray]
    video: np.ndarray
    frames_per_second: float


def inspect(path: pathlib.Path, *, max_bytes: int, **view: Any) -> Inspection:
    """Reads a demonstration file, and renders a part of it if it holds states.

    Args:
      path: file or folder of any format in `foreign.FORMATS`.
      max_bytes: the largest array that may be unpacked.
      view: `image_size` and `render_quality` of images rendered from states; videos are
        shrunk until their shorter side has that size.

    Raises:
      DemonstrationError: a file of states is damaged.
      ValueError: its states are not those of its task.
      FormatError: another file is, or is of no known format.
      OSError: it cannot be opened.
    """
    if states.recognises(path):
        return _inspect_states(path, view)
    recording = foreign.open_recording(
        path, max_bytes=max_bytes, image_size=view["image_size"], keep_aspect=True
    )
    speed = recording.frames_per_second
    summaries, pictures, video = [], [], np.empty((0, 1, 1, 3), np.uint8)
    for episode in recording.episodes:
        frames, actions, rewards = episode.frames, episode.actions, episode.rewards
        height, width = episode.stored_size or frames.shape[1:3]
        if len(pictures) < _NUM_ROWS:
            pictures.append(frames[spaced(len(frames))].copy())
        if not summaries:
            video = frames
        summaries.append(
            EpisodeSummary(
                len(frames),
                f"{width}x{height}",
                None if actions is None else actions.shape[1],
                None if rewards is None else float(rewards.sum()),
            )
        )
    facts = {
        "format": recording.kind,
        "task": recording.task or "unknown",
        "action repeat": str(recording.action_repeat or "unknown"),
        "frames per second": "unknown" if speed is None else f"{speed:g}",
    }
    for number, note in enumerate(recording.notes, start=1):
        facts[f"note {number}"] = note
    return Inspection(facts, summaries, pictures, video, speed or _DEFAULT_SPEED)


def _inspect_states(path: pathlib.Path, view: dict[str, Any]) -> Inspection:
    stored = states.read_states(path)
    metadata = stored.metadata
    num_episodes, num_steps = stored.rewards.shape
    versions = ", ".join(f"{k} {v}" for k, v in metadata["versions"].items())
    return Inspection(
        facts={
            "format": "jaxil states",
            "task": metadata["task"],
            "action repeat": str(metadata["action_repeat"]),
            "expert": metadata["expert"],
            "versions": versions,
            "size": f"{path.stat().st_size / 1e6:.2f} MB",
        },
        episodes=[
            EpisodeSummary(num_steps + 1, "rendered", stored.actions.shape[2], value)
            for value in metadata["returns"]
        ],
        pictures=[
            _render(stored, episode, spaced(num_steps + 1), view)
            for episode in range(min(num_episodes, _NUM_ROWS))
        ],
        video=_render(stored, 0, slice(None), view),
        frames_per_second=_speed(stored),
    )


def render_recording(path: pathlib.Path, **view: Any) -> Recording:
    """Opens a file of states as if it held the pixels that its task shows.

    Args:
      path: the file.
      view: `image_size` and `render_quality`.

    Raises:
      DemonstrationError: the file is damaged.
      ValueError: its states are not those of its task.
    """
    stored = states.read_states(path)

    def episodes() -> Iterator[PixelEpisode]:
        for index in range(len(stored.rewards)):
            frames = _render(stored, index, slice(None), view)
            yield PixelEpisode(frames, stored.actions[index], stored.rewards[index])

    return Recording(
        kind=f"jaxil states, rendered at quality {view['render_quality']}",
        num_episodes=len(stored.rewards),
        episodes=episodes(),
        task=stored.metadata["task"],
        action_repeat=stored.metadata["action_repeat"],
        frames_per_second=_speed(stored),
    )


def table(inspection: Inspection) -> str:
    """Returns the inspection as text, with one line for each episode."""
    lines = [f"{name}: {printable(text)}" for name, text in inspection.facts.items()]
    lines.append(f"episodes: {len(inspection.episodes)}")
    known = [row.task_return for row in inspection.episodes]
    if returns := [value for value in known if value is not None]:
        lines.append(
            f"return: mean {np.mean(returns):.1f}, minimum {min(returns):.1f}, "
            f"maximum {max(returns):.1f}"
        )
    lines.append(
        f"{'episode':>8}{'frames':>8}{'pixels':>12}{'actions':>9}{'return':>10}"
    )
    for index, row in enumerate(inspection.episodes):
        actions = "none" if row.action_dim is None else str(row.action_dim)
        value = "unknown" if row.task_return is None else f"{row.task_return:.1f}"
        lines.append(
            f"{index:>8}{row.num_frames:>8}{row.size:>12}{actions:>9}{value:>10}"
        )
    return "\n".join(lines)


def contact_sheet(inspection: Inspection) -> Image.Image:
    """Returns one row of pictures for each episode, time running to the right."""
    height, width = inspection.pictures[0].shape[1:3]
    scale = _MIN_SIDE / min(height, width)
    cell = (max(1, round(width * scale)), max(1, round(height * scale)))
    column_width, row_height = cell[0] + _MARGIN, cell[1] + _CAPTION + _MARGIN
    size = (
        NUM_COLUMNS * column_width + _MARGIN,
        len(inspection.pictures) * row_height + _MARGIN,
    )
    sheet = Image.new("RGB", size, (24, 24, 24))
    draw = ImageDraw.Draw(sheet)
    for row, pictures in enumerate(inspection.pictures):
        summary = inspection.episodes[row]
        top = _MARGIN + row * row_height
        caption = f"episode {row}, {summary.num_frames} frames"
        if summary.task_return is not None:
            caption += f", return {summary.task_return:.0f}"
        draw.text((_MARGIN, top), caption, fill=(235, 235, 235))
        for left, picture in zip(itertools.count(_MARGIN, column_width), pictures):
            image = Image.fromarray(picture).resize(cell, Image.Resampling.BILINEAR)
            sheet.paste(image, (left, top + _CAPTION))
    return sheet


def spaced(num_frames: int) -> np.ndarray:
    """Returns the indices of 8 evenly spaced frames, the first and last among them."""
    return np.linspace(0, num_frames - 1, NUM_COLUMNS).round().astype(int)


def _speed(stored: states.StateDemonstrations) -> float:
    metadata = stored.metadata
    return 1.0 / suite.decision_seconds(metadata["task"], metadata["action_repeat"])


def _render(
    stored: states.StateDemonstrations,
    episode: int,
    times: np.ndarray | slice,
    view: dict[str, Any],
) -> np.ndarray:
    """Returns images [N, S, S, 3] of some moments of an episode."""
    return rendering.observe_episodes(
        stored.simulator_states(times, slice(episode, episode + 1)),
        task=stored.metadata["task"],
        seed=stored.metadata["seed"],
        first_episode=stored.metadata["first_episode"] + episode,
        cache=False,
        **view,
    )[0]
