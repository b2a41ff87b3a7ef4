"""Episodes as files DIR/episode_00000012.npz, which are written once."""

import pathlib
import re

from jaxil.errors import printable
from jaxil.files import archive, untrusted, writing
from jaxil.maths.types import Episode
from jaxil.replay.replay import Replay

_NAME = re.compile(r"episode_(\d{8,})\.npz")


def write(folder: pathlib.Path, replay: Replay, index: int) -> int:
    """Writes one stored episode; returns the file's CRC-32."""
    path, arrays = _path(folder, index), replay.episode(index)._asdict()
    archive.write_archive(path, arrays.items(), level=1)  # 6: far slower, hardly less
    return untrusted.checksum(path)


def read_into(
    replay: Replay, folder: pathlib.Path, index: int, checksum: int
) -> str | None:
    """Adds one episode, or skips its number if the file is damaged.

    Returns what is wrong with the file, or None. `checksum` is what `write` returned.
    """
    path = _path(folder, index)
    try:
        limits = dict.fromkeys(Episode._fields, archive.MAX_BYTES)
        arrays = archive.read_archive(path, max_bytes=limits)
        # Zip's own checksums miss a file that was swapped for another.
        if checksum != untrusted.checksum(path):
            raise ValueError("has changed since it was written")
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
