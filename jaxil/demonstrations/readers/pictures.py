"""Folders of PNG or JPEG frames, and NumPy arrays (.npy): pixels alone.

A folder of pictures is one episode; in a folder without any, each subfolder of pictures
is one. An array is one episode [T, H, W] or [T, H, W, C]. Files are in the order of
their names, numbers by value.
"""

import contextlib
import pathlib
import re
from collections.abc import Iterator

import numpy as np
from PIL import Image

from jaxil.demonstrations.readers.frames import (
    as_rgb,
    resized,
    rgb_picture,
    wanted_size,
)
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

_NPY = b"\x93NUMPY"
_PICTURES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")
_SUFFIXES = (".png", ".jpg", ".jpeg")
_MAX_PIXELS = 100e6  # of one picture
_FRAMES_PER_HEARTBEAT = 30


def recognises(path: pathlib.Path) -> bool:
    """Returns whether this is an array, or a folder of arrays or pictures."""
    try:
        return bool(_episodes(path))
    except (OSError, ValueError):
        return False


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads episodes, scaling each frame as soon as it is read."""
    episodes = _episodes(path)
    is_array = _starts(episodes[0][0], _NPY)
    used = {file for files in episodes for file in files}
    notes = _ignored(path, used) if path.is_dir() else ()
    kind = "NumPy images" if is_array else "pictures"
    yield Recording(kind, len(episodes), notes=notes)
    for files in episodes:
        frames, stored, size = [], (0, 0), (0, 0)
        with naming(files[0] if is_array else files[0].parent, path):
            images = _array(files[0]) if is_array else map(_picture, files)
            for image in images:
                frame = as_rgb(np.asarray(image))
                if not frames:
                    stored = frame.shape[:2]
                    size = wanted_size(stored, options)
                if frame.shape[:2] != stored:
                    sizes = [f"{w}x{h}" for h, w in (stored, frame.shape[:2])]
                    what = f"has pictures of {' and '.join(sizes)} pixels"
                    raise FormatError(f"{what}; make them one size")
                frames.append(resized(frame, size, options.fit))
                name = f"{len(frames)} or more frames of {size[1]}x{size[0]} pixels,"
                num_bytes = len(frames) * frames[0].nbytes
                options.check_bytes(name, num_bytes, "; shrink or skip some")
                if len(frames) % _FRAMES_PER_HEARTBEAT == 0:
                    yield None
            yield PixelEpisode(np.stack(frames), stored_size=stored)


def _episodes(path: pathlib.Path) -> list[list[pathlib.Path]]:
    """Returns the files of each episode: an array, or one picture a frame."""
    if not path.is_dir():
        return [[path]] if _starts(path, _NPY) else []
    files = _visible(path)
    arrays = [[file] for file in files if _starts(file, _NPY)]
    pictures = [file for file in files if _starts(file, *_PICTURES)]
    if arrays or pictures:
        return arrays or [pictures]
    folders = [_visible(folder) for folder in files if folder.is_dir()]
    found = [[x for x in inside if _starts(x, *_PICTURES)] for inside in folders]
    return [pictures for pictures in found if pictures]


def _ignored(path: pathlib.Path, used: set[pathlib.Path]) -> tuple[str, ...]:
    """Returns a note of the files in a folder, and in those of episodes, not `used`.

    Raises:
      FormatError: one of them has a picture's name but is none.
    """
    folders = {path, *(file.parent for file in used)}
    others = [x for each in sorted(folders) for x in _visible(each) if x not in used]
    others = [x for x in others if x not in folders]
    for other in others:
        with contextlib.suppress(PermissionError):
            inside = _visible(other) if other.is_dir() else [other]
            if any(_starts(file, *_PICTURES) for file in inside):
                continue  # masks, thumbnails
            for file in inside:
                if file.suffix.lower() in _SUFFIXES and not file.is_dir():
                    what = f"holds {file.name}, which is no PNG or JPEG picture"
                    raise FormatError(f"{what}; replace or remove it")
    return (ignored(others),) if others else ()


def _visible(folder: pathlib.Path) -> list[pathlib.Path]:
    def order(path: pathlib.Path) -> list[tuple[int, str]]:
        return [(int(n or 0), text) for n, text in re.findall(r"(\d*)(\D*)", path.name)]

    return sorted((x for x in folder.iterdir() if x.name[0] != "."), key=order)


def _starts(path: pathlib.Path, *starts: bytes) -> bool:
    return first_bytes(path, 8).startswith(starts)


def _array(path: pathlib.Path) -> np.ndarray:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise FormatError(f"is cut off or damaged ({error})") from error
    channels = array.shape[3] if array.ndim == 4 else 1
    if array.ndim not in (3, 4) or array.size == 0 or channels not in (1, 3, 4):
        raise FormatError(f"has shape {array.shape}, not [T, H, W] or [T, H, W, C]")
    return array


def _picture(path: pathlib.Path) -> np.ndarray:
    with naming(path, path.parent):
        try:
            with Image.open(path, formats=("PNG", "JPEG")) as image:
                if image.width * image.height > _MAX_PIXELS:
                    raise FormatError(f"has {image.width}x{image.height} pixels")
                return rgb_picture(image)
        except FormatError:
            raise
        except Exception as error:  # Pillow's parsers raise many kinds
            raise FormatError("is cut off or damaged") from error
