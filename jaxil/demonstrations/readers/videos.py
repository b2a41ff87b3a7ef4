"""Video files, one episode each, without actions or rewards.

PyAV gets the open file and a parser chosen by the first bytes. A playlist disguised as
a video therefore cannot make it open other files.
"""

import contextlib
import itertools
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from PIL import Image

from jaxil.demonstrations.readers.frames import resized, wanted_size
from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    ReadOptions,
    Recording,
    first_bytes,
    ignored,
    naming,
)

_SUFFIXES = (".mp4", ".m4v", ".mov", ".gif", ".webm", ".mkv", ".avi")
_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")  # first in MP4 or MOV
_MAX_ENTRIES = 1000  # of a folder, searched for videos
_MAX_UNEVENNESS = 1.5  # longest time between two frames, over the shortest
_FRAMES_PER_HEARTBEAT = 30

_Frame = tuple[np.ndarray, tuple[int, int]]  # scaled frame, size in the file


def recognises(path: pathlib.Path) -> bool:
    """Returns whether this is a video file or a folder with one."""
    try:
        if not path.is_dir():
            return _parser_of(path) is not None
        entries = itertools.islice(_visible(path), _MAX_ENTRIES)
        return any(_parser_of(entry) is not None for entry in entries)
    except (OSError, ValueError):
        return False


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads a video file, or a folder of them in order of name.

    Each stored frame is used once, whatever its timestamp, and scaled to the size of
    the first. Any error of FFmpeg rejects the file.
    """
    files, others = [path], []
    if path.is_dir():
        files = [x for x in sorted(_visible(path)) if _parser_of(x) is not None]
        others = sorted(set(_visible(path)) - set(files))
    for other in others:
        if other.suffix.lower() in _SUFFIXES:
            raise FormatError(f"holds {other.name}, which is not a video")
    if not files:
        raise FormatError("holds no video")
    with naming(files[0], path):
        rate, is_even = timing(files[0])
    notes = ()
    if not is_even:
        notes += (
            f"{files[0].name} has unevenly spaced frames, read as evenly spaced.",
        )
    if others:
        notes += (ignored(others),)
    yield Recording(
        kind="folder of videos" if path.is_dir() else "video",
        num_episodes=len(files),
        frames_per_second=rate and rate / options.frame_skip,
        notes=notes,
    )
    for file in files:
        with naming(file, path):
            other_rate, _ = timing(file)
            if rate and other_rate and not 0.95 < other_rate / rate < 1.05:
                raise FormatError(
                    f"has {other_rate:.4g} frames per second, but {files[0].name} has "
                    f"{rate:.4g}"
                )
            way_out = "; skip some with frame_skip"
            yield from collect(decode(file, options), options, way_out)


def collect(
    frames: Iterable[_Frame], options: ReadOptions, way_out: str = ""
) -> Iterator[PixelEpisode | None]:
    """Yields None as a heartbeat, and then all frames as one episode."""
    pixels = bytearray()  # grows without a second copy
    shape, stored_size, num_frames = (1, 1, 3), None, 0
    for frame, size in frames:
        if num_frames % options.frame_skip == 0:
            shape, stored_size = frame.shape, stored_size or size
            pixels += frame.tobytes()
            what = f"{num_frames + 1} or more frames of {shape[1]}x{shape[0]} pixels,"
            options.check_bytes(what, len(pixels), way_out)
        num_frames += 1
        if num_frames % _FRAMES_PER_HEARTBEAT == 0:
            yield None
    if num_frames <= options.frame_skip:
        too_few = f"too few for frame_skip={options.frame_skip}"
        raise FormatError(f"has {num_frames} frames, {too_few}")
    episode = np.frombuffer(pixels, np.uint8).reshape(-1, *shape)
    yield PixelEpisode(episode, stored_size=stored_size)


def timing(path: pathlib.Path) -> tuple[float | None, bool]:
    """Returns frames per second, if known, and whether they are evenly spaced.

    Reads the packets without decoding them.
    """
    file_bytes, packet_bytes, num_frames, times = path.stat().st_size, 0, 0, []
    with _opened(path) as (container, stream):
        for packet in container.demux(stream):
            if packet.size == 0:
                continue  # the end
            num_frames += 1
            packet_bytes += packet.size
            if packet_bytes > file_bytes:
                raise FormatError("is damaged: its frames overlap")
            time = packet.dts if packet.pts is None else packet.pts
            if time is not None:
                times.append(time)
        unit, rate = stream.time_base, stream.average_rate
    if _parser_of(path) == "gif" and _frames_of_gif(path) != num_frames:
        raise FormatError(f"is cut off or damaged after {num_frames} frames")
    times.sort()
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    if unit and sum(gaps):
        rate = len(gaps) / (sum(gaps) * unit)
    # The 1 allows for rounding: time units may be as coarse as milliseconds.
    is_even = not gaps or max(gaps) - 1 <= _MAX_UNEVENNESS * (min(gaps) + 1)
    return rate and float(rate), is_even


def _frames_of_gif(path: pathlib.Path) -> int:
    """Returns the number of frames, or -1 if the file is damaged.

    FFmpeg mistakes damage for the end of the file.
    """
    if not path.read_bytes().rstrip(b"\0\r\n ").endswith(b";"):
        return -1
    try:
        with Image.open(path, formats=("GIF",)) as image:
            return getattr(image, "n_frames", 1)
    except Exception:  # Pillow's parsers raise many kinds
        return -1


def decode(path: pathlib.Path, options: ReadOptions) -> Iterator[_Frame]:
    """Yields all frames [H, W, 3], rotated and scaled, with their original size.

    Frames that `options` skips come empty.
    """
    from av.video.reformatter import VideoReformatter

    size = None
    reformatter = VideoReformatter()
    with _opened(path) as (container, stream):
        for index, frame in enumerate(container.decode(stream)):
            if index % options.frame_skip:
                yield np.empty((0, 0, 3), np.uint8), (0, 0)
                continue
            rgb = reformatter.reformat(frame, format="rgb24", threads=1)
            picture = _upright(rgb.to_ndarray(), frame)
            stored = picture.shape[:2]
            if size is None:
                size = wanted_size(stored, options)
            yield resized(picture, size, options.fit), stored


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator[tuple[Any, Any]]:
    """Opens a file's first video stream; errors of FFmpeg become FormatErrors."""
    import av
    import av.error
    import av.logging

    parser = _parser_of(path)
    if parser is None:
        raise FormatError("is not a video or not a regular file")
    av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    try:
        with (
            path.open("rb") as file,
            av.logging.Capture() as complaints,
            av.open(file, format=parser) as container,
        ):
            if not container.streams.video:
                raise FormatError("has no video stream")
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            stream.codec_context.options = {"err_detect": "explode"}
            yield container, stream
    except av.error.FFmpegError as error:
        raise FormatError(f"is cut off or damaged (FFmpeg: {error})") from error
    if complaints:
        raise FormatError(f"is cut off or damaged (FFmpeg: {complaints[0][2]})")


def _upright(picture: np.ndarray, frame: Any) -> np.ndarray:
    """Applies the frame's rotation and flips to its image [H, W, 3]."""
    from av.sidedata.sidedata import Type

    matrix = frame.side_data.get(Type.DISPLAYMATRIX)
    if matrix is None:
        return picture
    # x' = a x + c y, y' = b x + d y; only quarter turns and flips are supported.
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].tolist()
    if abs(b) > abs(a):
        picture, a, d = picture.swapaxes(0, 1), c, b
    return np.ascontiguousarray(picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def _parser_of(path: pathlib.Path) -> str | None:
    """Returns FFmpeg's name of the file's format; None if it is not a video."""
    start = first_bytes(path, 12)
    if start[4:8] in _BOXES:
        return "mov"
    if start.startswith((b"GIF87a", b"GIF89a")):
        return "gif"
    if start.startswith(b"RIFF") and start.endswith(b"AVI "):
        return "avi"
    return "matroska" if start.startswith(b"\x1aE\xdf\xa3") else None


def _visible(folder: pathlib.Path) -> Iterator[pathlib.Path]:
    return (path for path in folder.iterdir() if not path.name.startswith("."))
