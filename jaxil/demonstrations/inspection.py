"""What a demonstration file holds, for the eye: a table, a contact sheet, a video."""

import pathlib
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from jaxil.demonstrations import foreign, rendering, states
from jaxil.demonstrations.readers.recording import PixelEpisode, Recording
from jaxil.environments import suite
from jaxil.files.untrusted import printable

NUM_COLUMNS = 8  # pictures of an episode on the sheet
_NUM_ROWS = 10  # episodes on the sheet
_LEAST_SIDE = 96  # pixels of a picture on the sheet
_MARGIN = 4
_CAPTION = 16
_DEFAULT_SPEED = 25.0  # frames per second, where a file doesn't say


class EpisodeSummary(NamedTuple):
    """One row of the table.

    Attributes:
      num_frames: N + 1.
      height: of a frame, in pixels; 0 for states.
      width: likewise.
      action_dim: None without actions.
      task_return: None without rewards.
    """

    num_frames: int
    height: int
    width: int
    action_dim: int | None
    task_return: float | None


class Inspection(NamedTuple):
    """What was seen of a file.

    Attributes:
      kind: the format, for people.
      facts: label and text of what the file says of itself.
      episodes: one summary each.
      pictures: of up to ten episodes, uint8 [8, H, W, 3] each, evenly spaced in time.
      video: the first episode, uint8 [N + 1, H, W, 3].
      frames_per_second: of the video.
    """

    kind: str
    facts: dict[str, str]
    episodes: list[EpisodeSummary]
    pictures: list[np.ndarray]
    video: np.ndarray
    frames_per_second: float


def inspect(
    path: pathlib.Path, *, image_size: int, render_quality: str, max_bytes: int
) -> Inspection:
    """Reads all of a demonstration file, and draws a little of it if it holds states.

    Args:
      path: file or folder of any format in `foreign.FORMATS`.
      image_size: of images rendered from states; videos with larger frames are shrunk
        until their shorter side has this size.
      render_quality: likewise.
      max_bytes: the largest array that may be unpacked.

    Raises:
      DemonstrationError: a file of states is damaged.
      FormatError: another file is, or is of no known format.
      OSError: it can't be opened.
    """
    if states.recognises(path):
        return _inspect_states(path, image_size, render_quality)
    recording = foreign.open_recording(
        path, max_bytes=max_bytes, image_size=image_size, keep_aspect=True
    )
    speed = recording.frames_per_second
    summaries, pictures, video = [], [], np.empty((0, 1, 1, 3), np.uint8)
    for episode in recording.episodes:
        frames = episode.frames
        if len(pictures) < _NUM_ROWS:
            pictures.append(frames[_spaced(len(frames))].copy())
        if not summaries:
            video = frames
        summaries.append(_summary(episode))
    facts = {
        "task": recording.task or "not said",
        "action repeat": str(recording.action_repeat or "not said"),
        "frames per second": "not said" if speed is None else f"{speed:g}",
    }
    for number, note in enumerate(recording.notes, start=1):
        facts[f"note {number}"] = note
    return Inspection(
        recording.kind, facts, summaries, pictures, video, speed or _DEFAULT_SPEED
    )


def render_recording(
    path: pathlib.Path, *, image_size: int, render_quality: str
) -> Recording:
    """Opens a file of states as if it held the pixels that its task shows.

    Args:
      path: the file.
      image_size: height and width in pixels.
      render_quality: "paper", "fast" or "smooth".

    Raises:
      DemonstrationError: the file is damaged.
    """
    stored = states.read_states(path)
    metadata = stored.metadata
    repeat = metadata["action_repeat"]

    def episodes():
        for index in range(len(stored.rewards)):
            frames = _draw(stored, index, slice(None), image_size, render_quality)
            yield PixelEpisode(frames, stored.actions[index], stored.rewards[index])

    return Recording(
        kind=f"jaxil states, drawn at quality {render_quality}",
        num_episodes=len(stored.rewards),
        episodes=episodes(),
        task=metadata["task"],
        action_repeat=repeat,
        frames_per_second=1.0 / suite.decision_seconds(metadata["task"], repeat),
    )


def table(inspection: Inspection) -> str:
    """Returns the inspection as text of a few lines, one for each episode."""
    lines = [f"format: {inspection.kind}"]
    lines += [f"{name}: {printable(text)}" for name, text in inspection.facts.items()]
    returns = [
        summary.task_return
        for summary in inspection.episodes
        if summary.task_return is not None
    ]
    lines.append(f"episodes: {len(inspection.episodes)}")
    if returns:
        lines.append(
            f"return: mean {np.mean(returns):.1f}, minimum {min(returns):.1f}, "
            f"maximum {max(returns):.1f}"
        )
    lines.append(
        f"{'episode':>8}{'frames':>8}{'pixels':>12}{'actions':>9}{'return':>10}"
    )
    for index, row in enumerate(inspection.episodes):
        size = f"{row.width}x{row.height}" if row.height else "drawn"
        actions = "none" if row.action_dim is None else str(row.action_dim)
        worth = "unknown" if row.task_return is None else f"{row.task_return:.1f}"
        lines.append(f"{index:>8}{row.num_frames:>8}{size:>12}{actions:>9}{worth:>10}")
    return "\n".join(lines)


def contact_sheet(inspection: Inspection) -> Image.Image:
    """Returns one row of pictures for each episode, time running to the right."""
    height, width = inspection.pictures[0].shape[1:3]
    scale = _LEAST_SIDE / min(height, width)
    cell = (max(1, round(width * scale)), max(1, round(height * scale)))
    sheet = Image.new(
        "RGB",
        (
            NUM_COLUMNS * (cell[0] + _MARGIN) + _MARGIN,
            len(inspection.pictures) * (cell[1] + _CAPTION + _MARGIN) + _MARGIN,
        ),
        (24, 24, 24),
    )
    draw = ImageDraw.Draw(sheet)
    for row, (pictures, summary) in enumerate(
        zip(inspection.pictures, inspection.episodes, strict=False)
    ):
        top = _MARGIN + row * (cell[1] + _CAPTION + _MARGIN)
        caption = f"episode {row}, {summary.num_frames} frames"
        if summary.task_return is not None:
            caption += f", return {summary.task_return:.0f}"
        draw.text((_MARGIN, top), caption, fill=(235, 235, 235))
        for column, picture in enumerate(pictures):
            image = Image.fromarray(picture).resize(cell, Image.Resampling.BILINEAR)
            sheet.paste(image, (_MARGIN + column * (cell[0] + _MARGIN), top + _CAPTION))
    return sheet


def _inspect_states(
    path: pathlib.Path, image_size: int, render_quality: str
) -> Inspection:
    stored = states.read_states(path)
    metadata = stored.metadata
    num_episodes, num_steps = stored.rewards.shape
    columns = _spaced(num_steps + 1)
    rows = range(min(num_episodes, _NUM_ROWS))
    repeat = metadata["action_repeat"]
    return Inspection(
        kind="jaxil states",
        facts={
            "task": metadata["task"],
            "action repeat": str(repeat),
            "expert": metadata["expert"],
            "versions": ", ".join(f"{k} {v}" for k, v in metadata["versions"].items()),
            "size": f"{path.stat().st_size / 1e6:.2f} MB",
        },
        episodes=[
            EpisodeSummary(num_steps + 1, 0, 0, stored.actions.shape[2], value)
            for value in metadata["returns"]
        ],
        pictures=[
            _draw(stored, row, columns, image_size, render_quality) for row in rows
        ],
        video=_draw(stored, 0, slice(None), image_size, render_quality),
        frames_per_second=1.0 / suite.decision_seconds(metadata["task"], repeat),
    )


def _draw(
    stored: states.StateDemonstrations,
    episode: int,
    times: np.ndarray | slice,
    image_size: int,
    render_quality: str,
) -> np.ndarray:
    """Returns images [N, S, S, 3] of some moments of an episode."""
    return rendering.observe_episodes(
        {
            name: getattr(stored, name)[episode : episode + 1, times]
            for name in ("qpos", "qvel", "act")
        },
        task=stored.metadata["task"],
        seed=stored.metadata["seed"],
        first_episode=stored.metadata["first_episode"] + episode,
        image_size=image_size,
        render_quality=render_quality,
        cache=False,
    )[0]


def _summary(episode: PixelEpisode) -> EpisodeSummary:
    height, width = episode.stored_size or episode.frames.shape[1:3]
    return EpisodeSummary(
        num_frames=len(episode.frames),
        height=height,
        width=width,
        action_dim=None if episode.actions is None else episode.actions.shape[1],
        task_return=None if episode.rewards is None else float(episode.rewards.sum()),
    )


def _spaced(num_frames: int) -> np.ndarray:
    """Returns the indices of evenly spaced frames, the first and last among them."""
    return np.linspace(0, num_frames - 1, NUM_COLUMNS).round().astype(int)
