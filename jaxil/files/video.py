"""Videos of an episode, the agent beside the expert."""

import contextlib
import os
import pathlib
import subprocess
import uuid
from collections.abc import Iterator

import numpy as np

_LEAST_HEIGHT = 256  # pixels; smaller frames are enlarged by a whole factor
_GAP = 8  # pixels between the two pictures
_CAPTION = 22  # pixels, the strip above them that says who is who


def write_video(
    path: str | os.PathLike,
    frames_left: np.ndarray,
    frames_right: np.ndarray | None = None,
    *,
    fps: float,
    labels: tuple[str, str] = ("agent", "expert"),
) -> None:
    """Writes an MP4 of one episode, or of two side by side.

    The shorter episode stands still at its last frame until the longer one ends. Pixels
    are repeated, not blurred, so that the picture shows what the agent sees.

    Args:
      path: the file, ending in .mp4; it is replaced as a whole.
      frames_left: [T, H, W, 3] uint8, T >= 1.
      frames_right: [T', H, W, 3] uint8 of the same size, or None.
      fps: frames per second of the video, > 0.
      labels: captions of the left and right picture.

    Raises:
      ValueError: for a wrong shape or dtype.
      OSError: if the file cannot be written.
    """
    sides = [frames_left] if frames_right is None else [frames_left, frames_right]
    for name, frames in zip(("frames_left", "frames_right"), sides, strict=False):
        if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
            raise ValueError(
                f"{name} = {frames.dtype} {frames.shape}: expected uint8 [T, H, W, 3]"
            )
        if not len(frames) or frames.shape[1:] != frames_left.shape[1:]:
            raise ValueError(
                f"{name}.shape = {frames.shape}: expected at least one frame,"
                f" of {frames_left.shape[1:]}"
            )
    if not fps > 0:
        raise ValueError(f"fps = {fps}: expected > 0")

    canvas, corners, factor = _canvas(frames_left.shape[1:3], labels[: len(sides)])

    def pictures() -> Iterator[np.ndarray]:
        for step in range(max(map(len, sides))):
            for frames, (row, column) in zip(sides, corners, strict=True):
                frame = frames[min(step, len(frames) - 1)]
                big = frame.repeat(factor, axis=0).repeat(factor, axis=1)
                canvas[row : row + big.shape[0], column : column + big.shape[1]] = big
            yield canvas

    path = pathlib.Path(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.tmp.mp4")
    try:
        _encode(temporary, pictures(), size=canvas.shape[:2], fps=fps)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _encode(
    path: pathlib.Path,
    pictures: Iterator[np.ndarray],
    *,
    size: tuple[int, int],
    fps: float,
) -> None:
    """Pipes pictures [H, W, 3] through ffmpeg into an H.264 file."""
    import imageio_ffmpeg

    # Its own write_frames runs Python code between fork and exec, which can deadlock a
    # process that has threads, as one with jax has; a process group does the same: an
    # interrupt (Ctrl-C) reaches us and not ffmpeg.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[1]}x{size[0]}", "-r", str(fps), "-i", "-"]
    # Every player understands 4:2:0 colours, which want even sizes.
    command += ["-c:v", "libx264", "-preset", "veryfast", "-crf", "18"]
    command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, process_group=0
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        # A broken pipe: ffmpeg has given up, and says why.
        with contextlib.suppress(BrokenPipeError):
            for picture in pictures:
                process.stdin.write(picture.tobytes())
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        said = process.stderr.read().decode(errors="replace").strip()
    if process.returncode != 0:
        raise OSError(f"{path.name}: ffmpeg could not write the video: {said}")


def _canvas(
    size: tuple[int, int], labels: tuple[str, ...]
) -> tuple[np.ndarray, list[tuple[int, int]], int]:
    """Makes the captioned background.

    Returns:
      The background [H', W', 3] with even sides, the upper left corner (row, column) of
      each picture on it, and the whole factor that pictures are enlarged by.
    """
    # Pillow comes with imageio.
    from PIL import Image, ImageDraw

    factor = max(1, -(-_LEAST_HEIGHT // size[0]))
    height, width = size[0] * factor, size[1] * factor
    total_height = _CAPTION + height
    total_width = width * len(labels) + _GAP * (len(labels) - 1)
    image = Image.new(
        "RGB", (total_width + total_width % 2, total_height + total_height % 2)
    )
    draw = ImageDraw.Draw(image)
    corners = [(_CAPTION, place * (width + _GAP)) for place in range(len(labels))]
    for label, (_, column) in zip(labels, corners, strict=True):
        draw.text((column + 4, 5), label, fill=(235, 235, 235))
    return np.array(image), corners, factor
