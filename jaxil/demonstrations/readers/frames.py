"""Pictures of several formats: scaling, stacks of frames, JPEG and PNG files."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from jaxil.demonstrations.readers.recording import FormatError, ReadOptions

_MAX_CHANNELS = 30  # ten frames; beyond that, an axis is a side of the picture


def resized(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Returns a frame [H, W, 3] scaled to (height, width), with antialiasing."""
    if frame.shape[:2] == size:
        return frame
    # Pillow's bilinear filter grows with the scale, so that no pixel is skipped.
    height, width = size
    image = Image.fromarray(frame)
    return np.asarray(image.resize((width, height), Image.Resampling.BILINEAR))


def newest_frames(observations: np.ndarray) -> np.ndarray:
    """Returns a copy of the newest picture of each stack, [T, H, W, 3].

    Sizes tell where the channels are: on the axis of 3, 6, 9, ... items, and if a side
    of the picture could be that too, on the shorter one.

    Args:
      observations: of n frames each, the newest last; uint8 [T, 3 n, H, W] or
        [T, H, W, 3 n].

    Raises:
      FormatError: it has another type or shape, or one that can be read both ways.
    """
    shape = observations.shape
    if observations.dtype != np.uint8:
        raise FormatError(
            f"has observations of type {observations.dtype}, where uint8 is expected"
        )
    channels = {
        axis: shape[axis]
        for axis in (1, 3)
        if len(shape) == 4 and shape[axis] in range(3, _MAX_CHANNELS + 1, 3)
    }
    if not channels:
        raise FormatError(
            f"has observations of shape {shape}, where coloured pictures are expected: "
            "[T, 3 n, H, W] or [T, H, W, 3 n]"
        )
    if len(set(channels.values())) < len(channels):
        raise FormatError(
            f"has observations of shape {shape}, which does not tell whether channels "
            "come first or last"
        )
    if min(channels, key=channels.__getitem__) == 1:
        observations = observations.transpose(0, 2, 3, 1)
    return np.array(observations[..., -3:], order="C")


def decode_pictures(files: Sequence[bytes], options: ReadOptions) -> np.ndarray:
    """Returns the pictures of JPEG or PNG files, uint8 [T, H, W, 3].

    Raises:
      FormatError: one is damaged, not RGB or of another size, or they are too large
        together.
    """
    pictures = []
    for index, content in enumerate(files):
        try:
            with Image.open(io.BytesIO(content), formats=("JPEG", "PNG")) as image:
                # From the header; nothing is decoded yet.
                name = f"{len(files)} pictures of {image.width}x{image.height} pixels"
                options.check_bytes(name, len(files) * image.width * image.height * 3)
                if image.mode != "RGB":
                    raise FormatError(f"has pictures of mode {image.mode}, not of RGB")
                pictures.append(np.asarray(image))
        except FormatError:
            raise
        except Exception as error:  # whatever a parser of Pillow stumbles over
            raise FormatError(f"has a damaged picture {index}") from error
    if len({picture.shape for picture in pictures}) != 1:
        raise FormatError("has pictures of different sizes, or none, in one episode")
    return np.stack(pictures)
