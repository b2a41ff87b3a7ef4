"""Writes videos of one episode, or of two side by side."""

import os
from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from jaxil.files import writing

_MIN_HEIGHT = 256  # pixels; smaller frames are enlarged by an integer factor
_GAP = 8  # pixels between the two images
_CAPTION = 22  # pixels of the strip above them


def write_video(
    path: str | os.PathLike,
    frames_left: np.ndarray,
    frames_right: np.ndarray | None = None,
    *,
    fps: float,
    labels: tuple[str, str] = ("agent", "expert"),
) -> None:
    """Writes an MP4 of one episode, or of two side by side.

    The shorter episode repeats its last frame until the longer one ends. Frames are
    enlarged without smoothing, to show what the agent sees.

    Args:
      path: the file, ending in .mp4; replaced atomically.
      frames_left: uint8 [T, H, W, 3], T >= 1.
      frames_right: uint8 [T', H, W, 3] of the same size, or None.
      fps: frames per second of the video.
      labels: captions.
    """
    import av
    import av.error

    sides = [frames_left] if frames_right is None else [frames_left, frames_right]
    for name, frames in zip(("frames_left", "frames_right"), sides, strict=False):
        if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
            found = f"{frames.dtype} {frames.shape}"
            raise ValueError(f"{name} = {found}: expected uint8 [T, H, W, 3]")
        if not len(frames) or frames.shape[1:] != frames_left.shape[1:]:
            expected = f"at least one frame of {frames_left.shape[1:]}"
            raise ValueError(f"{name}.shape = {frames.shape}: expected {expected}")
    canvas, corners, factor = _canvas(frames_left.shape[1:3], labels[: len(sides)])

    def images() -> Iterator[np.ndarray]:
        for step in range(max(map(len, sides))):
            for frames, (row, column) in zip(sides, corners, strict=True):
                frame = frames[min(step, len(frames) - 1)]
                big = frame.repeat(factor, axis=0).repeat(factor, axis=1)
                canvas[row : row + big.shape[0], column : column + big.shape[1]] = big
            yield canvas

    options = {"movflags": "+faststart"}  # browsers play it while it loads
    with writing.replacing(path) as temporary, temporary.open("wb") as file:
        try:
            with av.open(file, "w", "mp4", options=options) as container:
                stream = container.add_stream(
                    "libx264",
                    Fraction(fps).limit_denominator(60_000),
                    options={"preset": "veryfast", "crf": "18"},
                )
                stream.height, stream.width = canvas.shape[:2]
                stream.pix_fmt = "yuv420p"  # needs even sizes
                for image in images():
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
                container.mux(stream.encode())
        except av.error.FFmpegError as error:
            raise OSError(f"the video could not be encoded: {error}") from error


def _canvas(
    size: tuple[int, int], labels: tuple[str, ...]
) -> tuple[np.ndarray, list[tuple[int, int]], int]:
    """Makes the background with its captions.

    Returns:
      The background [H', W', 3] with even sides, the upper left corner (row, column) of
      each image on it, and the factor by which images are enlarged.
    """
    from PIL import Image, ImageDraw

    factor = max(1, -(-_MIN_HEIGHT // size[0]))
    height, width = size[0] * factor, size[1] * factor
    total_height = _CAPTION + height
    total_width = width * len(labels) + _GAP * (len(labels) - 1)
    image = Image.new(
        "RGB", (total_width + total_width % 2, total_height + total_height % 2)
    )
    draw = ImageDraw.Draw(image)
    corners = [(_CAPTION, index * (width + _GAP)) for index in range(len(labels))]
    for label, (_, column) in zip(labels, corners, strict=True):
        draw.text((column + 4, 5), label, fill=(235, 235, 235))
    return np.array(image), corners, factor
