"""Episodes as files DIR/episode_00000012.npz, which are written once."""

import pathlib
import re
import zipfile

import numpy as np

from jaxil.errors import printable
from jaxil.files import archive, writing
from jaxil.maths.types import Episode
from jaxil.replay.replay import Replay

_NAME = re.compile(r"episode_(\d{8,})\.npz")
# The file contains the episode's number, so that swapped files are noticed. Files of
# earlier versions lack it.
_NUMBER = "number"


def write(folder: pathlib.Path, replay: Replay, index: int) -> None:
    """Writes one stored episode."""
    arrays = {**replay.episode(index)._asdict(), _NUMBER: np.int64(index)}
    # np.savez_compressed uses level 6: far slower, hardly smaller.
    with (
        writing.replacing(_path(folder, index)) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
    ):
        for name, array in arrays.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(
                    member, np.asanyarray(array), allow_pickle=False
                )


def read_into(replay: Replay, folder: pathlib.Path, index: int) -> str | None:
    """Adds one episode, or skips its number if the file is damaged.

    Returns:
      What is wrong with the file, or None.
    """
    path = _path(folder, index)
    try:
        names = Episode._fields
        if _NUMBER in archive.member_names(path):
            names = (*names, _NUMBER)
        limit = archive.MAX_BYTES
        arrays = archive.read_archive(path, max_bytes=dict.fromkeys(names, limit))
        number = arrays.pop(_NUMBER, index)
        if number != index:
            raise ValueError(f"holds episode {number}")
        replay.add_episode(**arrays)
    except (OSError, ValueError) as error:
        replay.skip_episode()
        reason = error.strerror if isinstance(error, OSError) else error
        return f"{path.name}: {printable(reason, 160)}"
    return None


def remove_except(folder: pathlib.Path, first: int, end: int) -> None:
    """Removes the episodes whose numbers are not in [first, end)."""
    for path in folder.iterdir():
        match = _NAME.fullmatch(path.name)
        if match and not first <= int(match[1]) < end:
            writing.remove(path)


def _path(folder: pathlib.Path, index: int) -> pathlib.Path:
    return folder / f"episode_{index:08d}.npz"
