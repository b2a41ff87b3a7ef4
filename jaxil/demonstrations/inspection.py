"""Summarises a demonstration file as a table, a contact sheet and a video."""

import pathlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from jaxil import outside
from jaxil.demonstrations import foreign, rendering, states
from jaxil.demonstrations.readers.recording import PixelEpisode, Recording
from jaxil.environments import tasks
from jaxil.errors import printable

_NUM_COLUMNS = 8  # images of an episode on the contact sheet, at most
_NUM_ROWS = 10  # episodes on the contact sheet
_MIN_SIDE, _MAX_SIDE = 96, 1024  # pixels of an image on the contact sheet
_COMPARED = (16, 16)  # pixels, at which frames are compared
_MAX_COMPARED = 2000  # frames of an episode
_MARGIN = 4
_CAPTION = 16
_DEFAULT_FPS = 25.0


class EpisodeSummary(NamedTuple):
    """One row of the table."""

    num_frames: int  # N + 1
    size: str  # of a frame in pixels, "WxH"; "rendered" for states
    action_dim: int | None  # None without actions
    task_return: float | None  # None without rewards


class Picture(NamedTuple):
    """One image on the contact sheet."""

    time: int  # number of the frame in its episode
    frame: np.ndarray  # uint8 [H, W, 3]


class Inspection(NamedTuple):
    """The content of a file."""

    facts: dict[str, str]  # metadata as text, by label
    episodes: list[EpisodeSummary]
    pictures: list[list[Picture]]  # of ten episodes, the frames that differ most
    video: np.ndarray  # the first episode, uint8 [N + 1, H, W, 3]
    frames_per_second: float  # of the video


def inspect(
    path: pathlib.Path,
    *,
    image_size: int,
    render_quality: str = "paper",
    progress: Callable[[int, int], None] = lambda done, total: None,
    **options: Any,
) -> Inspection:
    """Reads a demonstration file of any format; renders samples of simulator states.

    Args:
      path: file or folder.
      image_size: of rendered states; the shorter side to which videos shrink.
      render_quality: of states.
      progress: called with (done, all): images of states, or episodes of pixels.
      options: for files of pixels, see `foreign.open_recording`.

    Raises:
      DemonstrationError: a file of states is damaged.
      ValueError: the states do not fit their task.
      FormatError: another file is damaged or has an unknown format.
    """
    if states.recognises(path):
        view = {"image_size": image_size, "render_quality": render_quality}
        return _inspect_states(path, progress, view)
    recording = foreign.open_recording(
        path, image_size=image_size, keep_aspect=True, **options
    )
    summaries, pictures, video = [], [], np.empty((0, 1, 1, 3), np.uint8)
    height = width = 0
    for episode in recording.episodes:
        progress(len(summaries), recording.num_episodes)
        frames, actions, rewards, stored_size = episode
        height, width = stored_size or frames.shape[1:3]
        if len(pictures) < _NUM_ROWS:
            # Evenly spaced ones, or all if they are few.
            spaced = np.linspace(0, len(frames) - 1, _MAX_COMPARED)
            compared = np.unique(spaced.round().astype(int))
            differing = most_different(np.stack([_small(frames[t]) for t in compared]))
            times = compared[differing]
            pictures.append([Picture(int(t), frames[t].copy()) for t in times])
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
    fps = recording.frames_per_second
    facts = {
        "format": recording.kind,
        "task": recording.task or "unknown",
        "action repeat": str(recording.action_repeat or "unknown"),
        "frames per second": "unknown" if fps is None else f"{fps:g}",
    }
    if recording.origin:
        facts["origin"] = recording.origin
    if height != width:
        ways = "demonstrations.fit=stretch (the default), crop or pad"
        facts["shape"] = f"not square: {ways}"
    for number, note in enumerate(recording.notes, start=1):
        facts[f"note {number}"] = note
    return Inspection(facts, summaries, pictures, video, fps or _DEFAULT_FPS)


def _inspect_states(
    path: pathlib.Path, progress: Callable[[int, int], None], view: dict[str, Any]
) -> Inspection:
    stored = _read_states(path)
    metadata = stored.metadata
    num_episodes, num_steps = stored.rewards.shape
    num_rows = min(num_episodes, _NUM_ROWS)
    total = num_rows * _NUM_COLUMNS + num_steps + 1
    pictures = []
    for row in range(num_rows):
        progress(row * _NUM_COLUMNS, total)
        # Compared by their positions, since rendering all of them would take minutes.
        scale = np.maximum(stored.qpos[row].std(axis=0), 1e-6)
        times = most_different(stored.qpos[row] / scale)
        frames = _render(stored, row, times, view)
        pictures.append([Picture(int(t), frame) for t, frame in zip(times, frames)])
    before = total - num_steps - 1
    view = {**view, "progress": lambda done, _: progress(before + done, total)}
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
        pictures=pictures,
        video=_render(stored, 0, slice(None), view),
        frames_per_second=_fps(stored),
    )


def render_recording(path: pathlib.Path, **view: Any) -> Recording:
    """Opens a file of states as a recording that is rendered while it is read.

    `view` is `image_size` and `render_quality`. Raises the errors of `inspect`.
    """
    stored = _read_states(path)

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
        frames_per_second=_fps(stored),
    )


def table(inspection: Inspection) -> str:
    """Formats the inspection as text, with one line per episode."""
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
    """Returns one row of images per episode, in order of time, with their numbers."""
    height, width = inspection.pictures[0][0].frame.shape[:2]
    scale = min(_MIN_SIDE / min(height, width), _MAX_SIDE / max(height, width))
    cell = (max(1, round(width * scale)), max(1, round(height * scale)))
    column_width, row_height = cell[0] + _MARGIN, cell[1] + _CAPTION + _MARGIN
    size = (
        _NUM_COLUMNS * column_width + _MARGIN,
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
        for column, (time, frame) in enumerate(pictures):
            left = _MARGIN + column * column_width
            image = Image.fromarray(frame).resize(cell, Image.Resampling.BILINEAR)
            sheet.paste(image, (left, top + _CAPTION))
            corner = (left + 3, top + _CAPTION + 1)
            draw.text(corner, str(time), (255, 255, 255), stroke_width=1, stroke_fill=0)
    return sheet


def most_different(points: np.ndarray) -> np.ndarray:
    """Returns the ascending indices of at most 8 points [N, D] that differ most.

    Farthest-point sampling, which starts with the first of N >= 1 points and ends when
    every other point equals a chosen one.
    """
    chosen = [0]
    distances = np.full(len(points), np.inf)
    for _ in range(_NUM_COLUMNS - 1):
        nearer = np.square(points - points[chosen[-1]]).sum(axis=1)
        distances = np.minimum(distances, nearer)
        if not distances.any():
            break
        chosen.append(int(distances.argmax()))
    return np.sort(chosen)


def _small(frame: np.ndarray) -> np.ndarray:
    """Returns a small grey image, flat, by which frames are compared."""
    grey = Image.fromarray(frame).convert("L")
    return np.asarray(grey.resize(_COMPARED, Image.Resampling.BOX), np.float32).ravel()


def _fps(stored: states.StateDemonstrations) -> float:
    metadata = stored.metadata
    seconds, _ = tasks.timing(metadata["task"], metadata["action_repeat"])
    return 1.0 / seconds if seconds else _DEFAULT_FPS


def _read_states(path: pathlib.Path) -> states.StateDemonstrations:
    """Reads states to render; their task must be trusted if it names code."""
    stored = states.read_states(path)
    if tasks.names_code(stored.metadata["task"]):
        outside.require_trusted({"task": stored.metadata["task"]}, path)
    return stored


def _render(
    stored: states.StateDemonstrations,
    episode: int,
    times: np.ndarray | slice,
    view: dict[str, Any],
) -> np.ndarray:
    """Renders an episode at some times: [N, S, S, 3]."""
    return rendering.observe_episodes(
        stored.simulator_states(times, slice(episode, episode + 1)),
        task=stored.metadata["task"],
        seed=stored.metadata["seed"],
        first_episode=stored.metadata["first_episode"] + episode,
        cache=False,
        **view,
    )[0]
