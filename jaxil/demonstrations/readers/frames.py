"""Images in several formats: scaling, stacks of frames, JPEG and PNG files."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from jaxil.demonstrations.readers.recording import FormatError, ReadOptions

_MAX_CHANNELS = 30  # of ten frames; a longer axis is the height or width


def resized(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Returns a frame [H, W, 3] scaled to (height, width), with antialiasing."""
    if frame.shape[:2] == size:
        return frame
    # Pillow's bilinear filter grows with the scale, which prevents aliasing.
    height, width = size
    image = Image.fromarray(frame)
    return np.asarray(image.resize((width, height), Image.Resampling.BILINEAR))


def newest_frames(observations: np.ndarray) -> np.ndarray:
    """Returns a copy of the newest frame of each stack, [T, H, W, 3].

    Channels are on the axis of length 3, 6, 9, ...; if that fits height or width too,
    on the shorter axis.

    Args:
      observations: uint8 [T, 3 n, H, W] or [T, H, W, 3 n]; the newest frame is last.

    Raises:
      FormatError: wrong type or shape, or the axis of channels is ambiguous.
    """
    shape = observations.shape
    if observations.dtype != np.uint8:
        raise FormatError(f"has observations of type {observations.dtype}, not uint8")
    channels = {
        axis: shape[axis]
        for axis in (1, 3)
        if len(shape) == 4 and shape[axis] in range(3, _MAX_CHANNELS + 1, 3)
    }
    if not channels:
        wanted = "[T, 3 n, H, W] or [T, H, W, 3 n]"
        raise FormatError(f"has observations of shape {shape}, not {wanted}")
    if len(set(channels.values())) < len(channels):
        raise FormatError(f"has observations of ambiguous shape {shape}")
    if min(channels, key=channels.__getitem__) == 1:
        observations = observations.transpose(0, 2, 3, 1)
    return np.array(observations[..., -3:], order="C")


def decode_pictures(files: Sequence[bytes], options: ReadOptions) -> np.ndarray:
    """Decodes RGB images of one size from JPEG or PNG files: uint8 [T, H, W, 3]."""
    pictures = []
    for index, content in enumerate(files):
        try:
            with Image.open(io.BytesIO(content), formats=("JPEG", "PNG")) as image:
                # Before anything is decoded.
                name = f"{len(files)} images of {image.width}x{image.height} pixels"
                options.check_bytes(name, len(files) * image.width * image.height * 3)
                if image.mode != "RGB":
                    raise FormatError(f"has images of mode {image.mode}, not RGB")
                pictures.append(np.asarray(image))
        except FormatError:
            raise
        except Exception as error:  # Pillow's parsers raise many kinds
            raise FormatError(f"has a damaged image {index}") from error
    if len({picture.shape for picture in pictures}) != 1:
        raise FormatError("has images of different sizes, or none, in one episode")
    return np.stack(pictures)
