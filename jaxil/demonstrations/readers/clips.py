"""Decoding of video files by ffmpeg: MP4, GIF, WebM.

A file's first bytes choose the parser, and ffmpeg gets the opened file, not its name: a
playlist in a video's clothes can't make it open anything else.
"""

import itertools
import os
import pathlib
import re
from collections.abc import Generator, Sequence
from typing import IO, NamedTuple

import numpy as np

from jaxil.demonstrations.readers.child import Child
from jaxil.demonstrations.readers.recording import FormatError

_CPU_SECONDS = 1.0  # for a tiny file
_BYTES_PER_SECOND = 5e6  # of the file, read on a slow machine
_PIXEL_BYTES_PER_SECOND = 1e7  # decoded there
_MEMORY_BYTES = 1024**3  # enough for ffmpeg at 3840x2160 pixels
_UNEVEN = 1.5  # longest time between two frames, over the shortest


class Clip(NamedTuple):
    """What a video file says of itself.

    Attributes:
      num_frames: how many are stored.
      height: pixels.
      width: pixels.
      frames_per_second: None where it has no times.
      is_even: whether all frames are shown for about the same time.
    """

    num_frames: int
    height: int
    width: int
    frames_per_second: float | None
    is_even: bool


def parser_of(path: pathlib.Path) -> str | None:
    """Returns what ffmpeg calls the format of a file; None for no video."""
    if not path.is_file():  # such as a named pipe, at which one would wait
        path.stat()
        return None
    with path.open("rb") as file:
        start = file.read(8)
    if start[4:8] == b"ftyp":
        return "mov"
    if start.startswith((b"GIF87a", b"GIF89a")):
        return "gif"
    return "matroska" if start.startswith(b"\x1aE\xdf\xa3") else None


def probe(
    path: pathlib.Path, *, max_bytes: int | None = None, frame_skip: int = 1
) -> Clip:
    """Reads size, times and number of a video's frames; decodes none of them.

    Args:
      path: the file.
      max_bytes: of all frames that are kept; None where they are not all to be kept.
      frame_skip: every n-th frame is kept.

    Raises:
      FormatError: it is no video or damaged, would fill more than `max_bytes`, or has
        fewer than two frames to keep.
      OSError: it cannot be opened.
    """
    num_bytes = path.stat().st_size
    height = width = packet_bytes = num_packets = 0
    unit = (0, 0)  # of time, a fraction of a second
    times = []
    seconds = _CPU_SECONDS + num_bytes / _BYTES_PER_SECOND
    with _ffmpeg(path, ["-c", "copy", "-f", "framecrc"], seconds) as child:
        while line := child.read_line():
            if found := re.fullmatch(rb"#tb 0: (\d+)/(\d+)", line):
                unit = int(found[1]), int(found[2])
            elif found := re.fullmatch(rb"#dimensions 0: (\d+)x(\d+)", line):
                width, height = int(found[1]), int(found[2])
            elif found := re.match(rb"0, +\S+, +(\S+), +\S+, +(\d+),", line):
                num_packets += 1
                packet_bytes += max(int(found[2]), 1)
                if packet_bytes > num_bytes:
                    raise FormatError("is damaged: its frames lie over one another")
                if found[1] != b"NOPTS":
                    times.append(int(found[1]))
                if max_bytes is not None:
                    check_size(-(-num_packets // frame_skip), height, width, max_bytes)
        _check_end(child)
    if parser_of(path) == "gif" and _gif_frames(path) != num_packets:
        raise FormatError(f"is damaged after {num_packets} frames")
    if not height * width:
        raise FormatError("is damaged: its frames have no size")
    check_number(num_packets, frame_skip)
    times.sort()
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    rate = None
    if gaps and all(unit) and times[-1] > times[0]:
        rate = len(gaps) * unit[1] / ((times[-1] - times[0]) * unit[0])
    # Clocks count as coarsely as in milliseconds, hence the 1.
    is_even = not gaps or max(gaps) - 1 <= _UNEVEN * (min(gaps) + 1)
    return Clip(num_packets, height, width, rate, is_even)


def decode(
    path: pathlib.Path, *, max_frame_bytes: int, cpu_seconds: float
) -> Generator[np.ndarray, None, None]:
    """Decodes a video frame by frame, as they are asked for.

    Args:
      path: the file.
      max_frame_bytes: of one frame, decoded.
      cpu_seconds: for all of it.

    Yields:
      Frames uint8 [H, W, 3], all of one size.

    Raises:
      FormatError: it is no video or damaged, or its frames are too large.
      OSError: it cannot be opened.
    """
    # Each frame once, whatever its time; a picture format tells the frame's size.
    output = ["-xerror", "-fps_mode", "passthrough"]
    output += ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24"]
    shape = None
    with _ffmpeg(path, output, cpu_seconds) as child:
        while child.read_line() == b"P6":
            sizes, largest_value = child.read_line().split(), child.read_line()
            if len(sizes) != 2 or largest_value != b"255":
                break  # it has given up in the middle
            width, height = map(int, sizes)
            if shape not in (None, (height, width, 3)):
                raise FormatError("changes the size of its frames on the way")
            shape = (height, width, 3)
            if height * width * 3 > max_frame_bytes:
                raise FormatError(
                    f"has frames of {width}x{height} pixels, {height * width * 3} "
                    f"bytes, more than the {max_frame_bytes} that are accepted"
                )
            frame = np.empty(shape, np.uint8)
            if child.read_into(frame.data.cast("B")) < frame.nbytes:
                break
            yield frame
        _check_end(child)


def cpu_seconds_for(clip: Clip, num_bytes: int) -> float:
    """Returns how long a slow machine may decode a file of `num_bytes`."""
    pixel_bytes = clip.num_frames * clip.height * clip.width * 3
    return (
        _CPU_SECONDS
        + num_bytes / _BYTES_PER_SECOND
        + pixel_bytes / _PIXEL_BYTES_PER_SECOND
    )


def check_size(num_frames: int, height: int, width: int, max_bytes: int) -> None:
    """Raises FormatError where that many decoded frames are more than `max_bytes`."""
    num_bytes = num_frames * height * width * 3
    if num_bytes > max_bytes:
        raise FormatError(
            f"has at least {num_frames} frames of {width}x{height} pixels, {num_bytes} "
            f"bytes, more than the {max_bytes} that are accepted"
        )


def check_number(num_frames: int, frame_skip: int) -> None:
    """Raises FormatError unless two of a video's frames are kept."""
    if num_frames <= frame_skip:
        raise FormatError(
            f"has {num_frames} frames, too few to keep two with frame_skip={frame_skip}"
        )


def _gif_frames(path: pathlib.Path) -> int:
    """Returns the number of a GIF's frames, since ffmpeg takes damage for its end.

    Source: GIF89a specification, CompuServe 1990.
    """
    num_frames = 0
    with path.open("rb") as file:
        _skip_colours(file, file.read(13)[10:11])
        while (kind := file.read(1)) != b";":
            if kind == b",":
                num_frames += 1
                _skip_colours(file, file.read(9)[8:9])
            elif kind != b"!":
                raise FormatError(f"is cut off or damaged after {num_frames} frames")
            file.seek(1, os.SEEK_CUR)
            while length := file.read(1).strip(b"\0"):
                file.seek(length[0], os.SEEK_CUR)
    return num_frames


def _skip_colours(file: IO[bytes], flags: bytes) -> None:
    """Goes behind a GIF's table of colours, if there is one."""
    if flags and flags[0] & 0x80:
        file.seek(3 * 2 ** (flags[0] % 8 + 1), os.SEEK_CUR)


def _ffmpeg(path: pathlib.Path, output: Sequence[str], cpu_seconds: float) -> Child:
    """Starts ffmpeg on a file's first moving picture; it writes to standard output."""
    import imageio_ffmpeg

    if path.exists() and not path.is_file():
        raise FormatError("is no file")
    parser = parser_of(path)
    if parser is None:
        raise FormatError("is no video (MP4, GIF or WebM)")
    try:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-hide_banner"]
    except RuntimeError as error:
        raise OSError(f"ffmpeg is missing: {error}") from error
    command += ["-loglevel", "error", "-protocol_whitelist", "fd", "-threads", "1"]
    command += ["-f", parser, "-fd", "0", "-i", "fd:", "-map", "0:V:0", *output, "-"]
    with path.open("rb") as file:
        return Child(
            command, cpu_seconds=cpu_seconds, memory_bytes=_MEMORY_BYTES, stdin=file
        )


def _check_end(child: Child) -> None:
    """Raises FormatError unless ffmpeg ended well and in silence."""
    if child.finish() or child.said:
        raise FormatError(f"is cut off or damaged (ffmpeg: {child.said})")
