"""Writes videos of one episode, or of two side by side."""

import itertools
import os
from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np

from jaxil.files import writing

_MIN_HEIGHT = 256  # pixels; smaller frames are enlarged by an integer factor
_MAX_WIDTH = 2048  # of enlarged frames
_GAP = 8  # pixels between the two images
_CAPTION = 22  # pixels of the strip above them
_TEXT = (235, 235, 235)
_GIF_COLOURS = 64

# One text, or one for each frame.
Caption = str | Sequence[str]


def write_video(
    path: str | os.PathLike,
    frames_left: np.ndarray,
    frames_right: np.ndarray | None = None,
    *,
    fps: float,
    labels: Sequence[Caption] = ("agent", "expert"),
) -> None:
    """Writes an MP4 of one episode, or of two side by side.

    The shorter episode repeats its last frame until the longer one ends. Frames are
    enlarged without smoothing, to show what the agent sees.

    Args:
      path: the file, ending in .mp4; replaced atomically.
      frames_left: uint8 [T, H, W, 3], T >= 1.
      frames_right: uint8 [T', H, W, 3] of the same size, or None.
      fps: frames per second of the video.
      labels: captions, one for each side.
    """
    import av
    import av.error

    images = _images(frames_left, frames_right, labels)
    first = next(images)
    options = {"movflags": "+faststart"}  # browsers play it while it loads
    with writing.replacing(path) as temporary:
        try:
            # FFmpeg opens the file: a Python file would hide why it cannot be written.
            # Absolute, since it takes what comes before a colon for a protocol.
            name = str(temporary.absolute())
            with av.open(name, "w", "mp4", options=options) as container:
                stream = container.add_stream(
                    "libx264",
                    Fraction(fps).limit_denominator(60_000),
                    options={"preset": "veryfast", "crf": "18"},
                )
                stream.height, stream.width = first.shape[:2]
                stream.pix_fmt = "yuv420p"  # needs even sizes
                for image in itertools.chain([first], images):
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
                container.mux(stream.encode())
        except av.error.FFmpegError as error:
            words = f"the video could not be encoded: {error.strerror}"
            raise OSError(words) from error


def write_gif(
    path: str | os.PathLike,
    frames_left: np.ndarray,
    frames_right: np.ndarray | None = None,
    *,
    fps: float,
    labels: Sequence[Caption] = ("agent", "expert"),
) -> None:
    """Writes what `write_video` would as an animated GIF that repeats for ever."""
    from PIL import Image

    # Pillow's default, median cut, turns a small orange body on blue ground grey.
    palette = Image.Quantize.FASTOCTREE
    images = (
        Image.fromarray(image).quantize(_GIF_COLOURS, palette, dither=Image.Dither.NONE)
        for image in _images(frames_left, frames_right, labels)
    )
    first = next(images)
    with writing.replacing(path) as temporary, temporary.open("wb") as file:
        first.save(
            file,
            "GIF",
            save_all=True,
            append_images=images,  # pyright: ignore[reportArgumentType]
            duration=round(1000 / fps),
            loop=0,
        )


def _images(
    frames_left: np.ndarray,
    frames_right: np.ndarray | None,
    labels: Sequence[Caption],
) -> Iterator[np.ndarray]:
    """Yields each frame's image, uint8 [H', W', 3] with even sides.

    Raises:
      ValueError: frames of another type or shape, or of two sizes.
    """
    from PIL import Image, ImageDraw

    sides = [frames_left] if frames_right is None else [frames_left, frames_right]
    for name, frames in zip(("frames_left", "frames_right"), sides, strict=False):
        if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
            found = f"{frames.dtype} {frames.shape}"
            raise ValueError(f"{name} = {found}: expected uint8 [T, H, W, 3]")
        if not len(frames) or frames.shape[1:] != frames_left.shape[1:]:
            expected = f"at least one frame of {frames_left.shape[1:]}"
            raise ValueError(f"{name}.shape = {frames.shape}: expected {expected}")
    enlarged = min(
        -(-_MIN_HEIGHT // frames_left.shape[1]), _MAX_WIDTH // frames_left.shape[2]
    )
    factor = max(1, enlarged)
    height, width = (side * factor for side in frames_left.shape[1:3])
    total_height = _CAPTION + height
    total_width = width * len(sides) + _GAP * (len(sides) - 1)
    size = (total_width + total_width % 2, total_height + total_height % 2)
    for step in range(max(map(len, sides))):
        canvas = Image.new("RGB", size)
        draw = ImageDraw.Draw(canvas)
        for index, (frames, label) in enumerate(zip(sides, labels, strict=False)):
            column = index * (width + _GAP)
            frame = Image.fromarray(frames[min(step, len(frames) - 1)])
            big = frame.resize((width, height), Image.Resampling.NEAREST)
            canvas.paste(big, (column, _CAPTION))
            text = label if isinstance(label, str) else label[min(step, len(label) - 1)]
            draw.text((column + 4, 5), text, fill=_TEXT)
        yield np.array(canvas)
