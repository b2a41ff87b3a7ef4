"""Images in several formats: scaling, stacks of frames, JPEG and PNG files."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageOps

from jaxil.demonstrations.readers.recording import FormatError, ReadOptions

_MAX_CHANNELS = 30  # of ten frames; a longer axis is the height or width


def resized(
    frame: np.ndarray, size: tuple[int, int], fit: str = "stretch"
) -> np.ndarray:
    """Returns a frame [H, W, 3] scaled to (height, width), with antialiasing.

    Where the shapes differ, `fit` is "stretch", "crop" to the middle, or "pad" with
    black.
    """
    if frame.shape[:2] == size:
        return frame
    # Pillow's bilinear filter grows with the scale, which prevents aliasing.
    wanted, image = (size[1], size[0]), Image.fromarray(frame)
    bilinear = Image.Resampling.BILINEAR
    if fit == "crop":
        return np.asarray(ImageOps.fit(image, wanted, bilinear))
    if fit == "pad":
        return np.asarray(ImageOps.pad(image, wanted, bilinear, color=(0, 0, 0)))
    return np.asarray(image.resize(wanted, bilinear))


def wanted_size(stored: tuple[int, int], options: ReadOptions) -> tuple[int, int]:
    """Returns the (height, width) that frames of a stored size are scaled to."""
    if options.image_size is None:
        return stored
    if not options.keep_aspect:
        return options.image_size, options.image_size
    scale = min(1.0, options.image_size / min(stored))
    return max(1, round(stored[0] * scale)), max(1, round(stored[1] * scale))


def as_rgb(image: np.ndarray) -> np.ndarray:
    """Returns an image of another kind as uint8 [H, W, 3].

    It is gray [H, W] or [H, W, 1], RGB, or RGBA, whose alpha is dropped; of uint8,
    bool, uint16 of the full range, or floats in [0, 1]. Others raise FormatError.
    """
    if image.ndim < 3 or image.shape[-1] not in (1, 3, 4):
        image = image[..., None]
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    elif image.dtype == bool:
        image = image.astype(np.uint8) * np.uint8(255)
    elif image.dtype.kind == "f":
        if not (np.min(image) >= 0.0 and np.max(image) <= 1.0):
            raise FormatError("has images of real numbers outside [0, 1]; save uint8")
        image = np.rint(image * 255.0).astype(np.uint8)
    if image.dtype != np.uint8:
        raise FormatError(f"has images of type {image.dtype}; save uint8")
    return image[..., [0, 0, 0]] if image.shape[-1] == 1 else image[..., :3]


def newest_frames(observations: np.ndarray) -> np.ndarray:
    """Returns a copy of the newest frame of each stack, [T, H, W, 3].

    Observations are uint8 [T, 3 n, H, W] or [T, H, W, 3 n], the newest frame last.
    Channels are on the axis of length 3, 6, 9, ...; if that fits height or width too,
    on the shorter axis. Anything else raises FormatError.
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


def rgb_picture(image: Image.Image) -> np.ndarray:
    """Returns an opened picture of any mode as uint8 [H, W, 3]."""
    if image.mode.startswith(("I", "F")):  # 16 bits; Pillow's own conversion clips
        return as_rgb(np.asarray(image).astype(np.uint16))
    return np.asarray(image.convert("RGB"))


def decode_pictures(files: Sequence[bytes], options: ReadOptions) -> np.ndarray:
    """Decodes images of one size from JPEG or PNG files: uint8 [T, H, W, 3]."""
    pictures = []
    for index, content in enumerate(files):
        try:
            with Image.open(io.BytesIO(content), formats=("JPEG", "PNG")) as image:
                # Before anything is decoded.
                name = f"{len(files)} images of {image.width}x{image.height} pixels"
                options.check_bytes(name, len(files) * image.width * image.height * 3)
                pictures.append(rgb_picture(image))
        except FormatError:
            raise
        except Exception as error:  # Pillow's parsers raise many kinds
            raise FormatError(f"has a damaged image {index}") from error
    if len({picture.shape for picture in pictures}) != 1:
        raise FormatError("has images of different sizes, or none, in one episode")
    return np.stack(pictures)
