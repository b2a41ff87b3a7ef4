"""Minari datasets of the format "hdf5": episodes of images, actions and rewards.

Source of the format: Farama-Foundation/Minari, minari/dataset.
"""

import importlib.util
import json
import pathlib
import re
from collections.abc import Iterator
from typing import Any

from jaxil.demonstrations.readers import json_file, messages, minari_file
from jaxil.demonstrations.readers.child import Child
from jaxil.demonstrations.readers.recording import FormatError, PixelEpisode, Recording

_DATA, _METADATA = "main_data.hdf5", "metadata.json"
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MAX_METADATA_BYTES = 64 * 1024**2  # it has the bounds of every pixel
_HEAD_BYTES = 4096  # of the metadata, where the keys are that tell the format


def recognises(path: pathlib.Path) -> bool:
    """Tells whether this is a dataset's folder, or its `data` folder; never raises."""
    try:
        folder = _data_folder(path)
        if (folder / _DATA).is_file():
            with (folder / _DATA).open("rb") as file:
                return file.read(len(_HDF5)) == _HDF5
        with (folder / _METADATA).open("rb") as file:
            head = file.read(_HEAD_BYTES)
        return b'"data_format"' in head and b'"total_episodes"' in head
    except (OSError, ValueError):
        return False


def open_recording(path: pathlib.Path, *, max_bytes: int) -> Recording:
    """Opens a dataset whose observations hold exactly one image.

    That image is uint8 [H, W, 3], stored as it is or, as Minari does by itself from 32
    pixels a side on, as a JPEG. It may stand alone or in a dictionary. Actions that are
    no vectors of real numbers are left out, with a note.

    Args:
      path: the dataset's folder, or the `data` folder in it.
      max_bytes: of one episode's images.

    Raises:
      FormatError: it is no such dataset, or h5py is not installed.
      OSError: it cannot be opened.
    """
    folder = _data_folder(path)
    metadata = {}  # older datasets have none
    if (folder / _METADATA).exists():
        metadata = json_file.read_object(
            folder / _METADATA, max_bytes=_MAX_METADATA_BYTES
        )
    stored_as = metadata.get("data_format", "hdf5")
    if stored_as != "hdf5":
        raise FormatError(f"has data_format={stored_as!r:.50}; only 'hdf5' can be read")
    if importlib.util.find_spec("h5py") is None:
        raise FormatError("needs h5py: pip install 'jaxil[minari]'")
    file = folder / _DATA
    with _start(file, max_bytes) as child:
        facts = messages.receive(child, max_bytes=max_bytes).facts
    num_episodes = facts["num_episodes"]
    promised = metadata.get("total_episodes", num_episodes)
    if promised != num_episodes:
        raise FormatError(
            f"holds {num_episodes} episodes, where {_METADATA} says {promised!r:.50}"
        )

    def episodes() -> Iterator[PixelEpisode]:
        with _start(file, max_bytes) as child:
            messages.receive(child, max_bytes=max_bytes)
            for _ in range(num_episodes):
                arrays = messages.receive(child, max_bytes=max_bytes).arrays
                yield PixelEpisode(**arrays)

    return Recording(
        kind="Minari dataset",
        num_episodes=num_episodes,
        episodes=episodes(),
        task=_task_of(metadata),
        notes=tuple(facts["notes"]),
    )


def _data_folder(path: pathlib.Path) -> pathlib.Path:
    inner = path / "data"
    return inner if not (path / _METADATA).is_file() and inner.is_dir() else path


def _start(file: pathlib.Path, max_bytes: int) -> Child:
    return messages.open_child(minari_file.__name__, file, max_bytes=max_bytes)


def _task_of(metadata: dict[str, Any]) -> str | None:
    """Returns the task where it is one of dm_control, by the names that Shimmy uses."""
    try:
        name = json.loads(metadata["env_spec"])["id"]
        found = re.fullmatch(r"dm_control/([a-z_]+)-([a-z_]+)-v\d+", name)
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return None if found is None else f"{found[1]}_{found[2]}"
