"""Pictures that a dataset keeps as the bytes of JPEG or PNG files."""

import io
from collections.abc import Sequence

import numpy as np

from jaxil.demonstrations.readers.recording import FormatError

_FORMATS = ("JPEG", "PNG")


def prepare() -> None:
    """Loads all that is needed, for a process that can't open files afterwards."""
    from PIL import Image

    Image.preinit()


def decode_pictures(files: Sequence[bytes], *, max_bytes: int) -> np.ndarray:
    """Returns pictures of one size, uint8 [T, H, W, 3].

    Args:
      files: their bytes, T >= 1.
      max_bytes: of all pictures together.

    Raises:
      FormatError: one is damaged, not coloured or of another size, or they are too
        large together.
    """
    pictures = np.empty(0, np.uint8)
    for index, content in enumerate(files):
        picture = _decode(content, max_bytes // len(files), index)
        if not index:
            pictures = np.empty((len(files), *picture.shape), np.uint8)
        elif picture.shape != pictures.shape[1:]:
            raise FormatError(
                f"has a picture of shape {picture.shape} after others of "
                f"{pictures.shape[1:]}"
            )
        pictures[index] = picture
    return pictures


def _decode(content: bytes, max_bytes: int, index: int) -> np.ndarray:
    """Returns the picture of one file, uint8 [H, W, 3]."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=_FORMATS) as image:
            # From the header: nothing is decoded so far.
            num_bytes = image.width * image.height * 3
            if image.mode != "RGB":
                raise FormatError(f"has pictures of mode {image.mode}, not of RGB")
            if num_bytes > max_bytes:
                raise FormatError(
                    f"has a picture of {image.width}x{image.height} pixels, "
                    f"{num_bytes} bytes, more than the {max_bytes} that are accepted"
                )
            return np.array(image)
    except FormatError:
        raise
    except Exception as error:  # Pillow's parsers raise whatever they stumble over
        raise FormatError(f"has a damaged picture {index}") from error
