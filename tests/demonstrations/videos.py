"""Videos of known content."""

import pathlib
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import av
import numpy as np


def encode_video(
    path: pathlib.Path,
    frames: np.ndarray,
    codec: str = "libx264rgb",
    pixels: str = "rgb24",
    *,
    format: str | None = None,
    fps: Fraction | int = 25,
    times: Sequence[int] | None = None,
    container_options: dict[str, str] | None = None,
    **options: str,
) -> None:
    """Writes frames [T, H, W, 3], without loss unless the options say otherwise."""
    if codec == "libx264rgb":
        options = {"qp": "0", **options}
    options_ = container_options or {}
    with open_video(path, "w", format=format, options=options_) as container:
        stream = container.add_stream(codec, Fraction(fps), options=options)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = pixels
        for index, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture))
            frame = frame.reformat(format=pixels)
            frame.pts = index if times is None else times[index]
            frame.time_base = 1 / Fraction(fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def open_video(path: pathlib.Path, mode: Any = "r", **options: Any) -> Any:
    """Opens a video with PyAV; untyped, since its streams have many types."""
    return av.open(path, mode, **options)
