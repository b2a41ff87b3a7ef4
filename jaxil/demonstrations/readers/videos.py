"""Video files (MP4, GIF, WebM), one episode each: frames without actions or rewards."""

import contextlib
import itertools
import os
import pathlib
from collections.abc import Iterator

import numpy as np

from jaxil.demonstrations.readers import clips
from jaxil.demonstrations.readers.recording import FormatError, PixelEpisode, Recording

_SUFFIXES = (".mp4", ".m4v", ".mov", ".gif", ".webm", ".mkv")
_MAX_ENTRIES = 1000  # of a folder, looked at to find out whether it holds videos


def recognises(path: pathlib.Path) -> bool:
    """Tells whether this is a video file, or a folder that holds one; never raises."""
    try:
        if not path.is_dir():
            return clips.parser_of(path) is not None
        with os.scandir(path) as entries:
            return any(
                clips.parser_of(pathlib.Path(entry)) is not None
                for entry in itertools.islice(entries, _MAX_ENTRIES)
                if not entry.name.startswith(".")
            )
    except (OSError, ValueError):
        return False


def open_recording(
    path: pathlib.Path, *, max_bytes: int, frame_skip: int = 1
) -> Recording:
    """Opens a video file, or a folder of them, sorted by name.

    Frames are taken as they are stored, each once, whatever the times between them; one
    of another size is scaled to the first one's. They are decoded by ffmpeg; where it
    speaks of an error, the file is refused.

    Args:
      path: the file or folder.
      max_bytes: of one video's decoded frames, those skipped not counted.
      frame_skip: every n-th frame is kept, beginning with the first; >= 1.

    Raises:
      FormatError: there is no video, or the first one cannot be used.
      OSError: it cannot be opened.
    """
    if frame_skip < 1:
        raise ValueError(f"frame_skip = {frame_skip}: expected >= 1")
    is_folder = path.is_dir()
    files, ignored = _files_in(path) if is_folder else ([path], [])
    with _blaming(files[0], is_folder):
        first = clips.probe(files[0], max_bytes=max_bytes, frame_skip=frame_skip)

    def episodes() -> Iterator[PixelEpisode]:
        for file in files:
            with _blaming(file, is_folder):
                clip = first
                if file != files[0]:
                    clip = clips.probe(file, max_bytes=max_bytes, frame_skip=frame_skip)
                    _check_rate(clip, first, files[0])
                frames = _read(file, clip, max_bytes=max_bytes, frame_skip=frame_skip)
            yield PixelEpisode(frames)

    notes = []
    if not first.is_even:
        notes.append(
            f"{files[0].name} shows its frames for unequal times; they are taken as "
            "equal."
        )
    if ignored:
        names = ", ".join(ignored[:3]) + (", ..." if len(ignored) > 3 else "")
        notes.append(f"What is no video is not read: {names}.")
    rate = first.frames_per_second
    return Recording(
        kind="folder of videos" if is_folder else "video",
        num_episodes=len(files),
        episodes=episodes(),
        frames_per_second=None if rate is None else rate / frame_skip,
        notes=tuple(notes),
    )


def _read(
    path: pathlib.Path, clip: clips.Clip, *, max_bytes: int, frame_skip: int
) -> np.ndarray:
    """Returns every n-th frame, [N, H, W, 3]."""
    pixels = bytearray()  # grows where it stands, so there is never a second copy
    shape = (clip.height, clip.width, 3)
    seconds = clips.cpu_seconds_for(clip, path.stat().st_size)
    num_frames = 0
    for frame in clips.decode(path, max_frame_bytes=max_bytes, cpu_seconds=seconds):
        shape = frame.shape
        if num_frames % frame_skip == 0:
            # It may hold other frames than it says.
            kept = num_frames // frame_skip + 1
            clips.check_size(kept, shape[0], shape[1], max_bytes)
            pixels += frame.data.cast("B")
        num_frames += 1
    clips.check_number(num_frames, frame_skip)
    return np.frombuffer(pixels, np.uint8).reshape(-1, *shape)


def _files_in(folder: pathlib.Path) -> tuple[list[pathlib.Path], list[str]]:
    """Returns a folder's videos and the names of everything else, both sorted."""
    files, others = [], []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if clips.parser_of(path) is not None:
            files.append(path)
        elif path.suffix.lower() in _SUFFIXES:
            raise FormatError(f"holds {path.name}, which is no video")
        else:
            others.append(path.name)
    if not files:
        raise FormatError("holds no video (MP4, GIF or WebM)")
    return files, others


@contextlib.contextmanager
def _blaming(file: pathlib.Path, is_folder: bool) -> Iterator[None]:
    """Where a whole folder is read, names the file that a fault is in."""
    try:
        yield
    except FormatError as error:
        if not is_folder:
            raise
        raise FormatError(f"holds {file.name}, which {error}") from error


def _check_rate(clip: clips.Clip, first: clips.Clip, first_file: pathlib.Path) -> None:
    """Raises FormatError where two videos' time runs at different speeds."""
    rate, expected = clip.frames_per_second, first.frames_per_second
    if rate and expected and not 0.95 < rate / expected < 1.05:
        raise FormatError(
            f"has {rate:.4g} frames per second, where {first_file.name} has "
            f"{expected:.4g}"
        )
