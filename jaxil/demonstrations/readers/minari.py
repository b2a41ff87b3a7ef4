"""Minari datasets in HDF5.

Source of the format: Farama-Foundation/Minari, minari/dataset.
"""

import json
import pathlib
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxil.demonstrations.readers.frames import decode_pictures
from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    ReadOptions,
    Recording,
    first_bytes,
    read_json,
)
from jaxil.files.untrusted import require_regular

_DATA, _METADATA = "main_data.hdf5", "metadata.json"
_HDF5, _JPEG = b"\x89HDF\r\n\x1a\n", b"\xff\xd8\xff"
_FILTERS = {1, 2, 3, 32000}  # gzip, shuffle, fletcher32, lzf: not plug-ins
_MAX_RATIO = 1100  # of compression; gzip reaches 1032


def recognises(path: pathlib.Path) -> bool:
    """Returns whether this is a dataset's folder, or its `data` folder."""
    try:
        folder = _data_folder(path)
    except (OSError, ValueError):
        return False
    head = first_bytes(folder / _METADATA, 4096)
    is_described = b'"data_format"' in head and b'"total_episodes"' in head
    return is_described or is_hdf5(folder / _DATA)


def is_hdf5(path: pathlib.Path) -> bool:
    """Returns whether this is an HDF5 file."""
    return first_bytes(path, len(_HDF5)) == _HDF5


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads a dataset whose observations contain exactly one image.

    The image is alone or in a dictionary, stored as uint8 [H, W, 3] or as a JPEG, which
    Minari uses from 32x32 pixels on. Actions that are not vectors of real numbers are
    ignored.
    """
    folder = _data_folder(path)
    described = folder / _METADATA  # older datasets lack it
    metadata = read_json(described) if described.exists() else {}
    stored_as = metadata.get("data_format", "hdf5")
    if stored_as != "hdf5":
        raise FormatError(f"has data_format={stored_as!r:.50}, not 'hdf5'")
    try:
        import h5py
    except ImportError:
        raise FormatError("needs h5py: pip install h5py") from None
    require_regular(folder / _DATA)
    with h5py.File(folder / _DATA, "r", locking=False) as file:
        found = [re.fullmatch(r"episode_(\d{1,9})", str(name)) for name in file]
        numbers = sorted(int(match[1]) for match in found if match is not None)
        if not numbers or numbers != list(range(len(numbers))):
            raise FormatError("has no episodes numbered from 0")
        promised = metadata.get("total_episodes", len(numbers))
        if promised != len(numbers):
            raise FormatError(
                f"holds {len(numbers)} episodes, but {_METADATA} says {promised!r:.50}"
            )
        first = member(file, "episode_0")
        image = _image_in(first)
        notes = ()
        if _is_jpeg(member(first, image)):
            notes += ("Its images are JPEGs, which have artefacts.",)
        if _actions(first, options) is None:
            notes += ("Its actions are ignored: they are not vectors of real numbers.",)
        task = _task_of(metadata)
        yield Recording("Minari dataset", len(numbers), task=task, notes=notes)
        for number in numbers:
            episode = member(file, f"episode_{number}")
            yield PixelEpisode(
                _frames(member(episode, image), options),
                _actions(episode, options),
                values(member(episode, "rewards"), options),
            )


def _data_folder(path: pathlib.Path) -> pathlib.Path:
    inner = path / "data"
    return inner if not (path / _METADATA).is_file() and inner.is_dir() else path


def _task_of(metadata: dict[str, Any]) -> str | None:
    """Returns the dm_control task that one of Shimmy's environments wraps, if any."""
    try:
        name = json.loads(metadata["env_spec"])["id"]
        found = re.fullmatch(r"dm_control/([a-z_]+)-([a-z_]+)-v\d+", name)
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return None if found is None else f"{found[1]}_{found[2]}"


def member(group: Any, path: str) -> Any:
    """Returns a group or dataset of this file; follows no links."""
    import h5py

    for name in path.split("/"):
        if not isinstance(group, h5py.Group) or name not in group:
            raise FormatError(f"has no {name} in {group.name}")
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise FormatError(f"has a link in place of {name}")
        group = group[name]
    return group


def _image_in(episode: Any) -> str:
    """Returns the path of the one image in an observation."""
    import h5py

    observations = member(episode, "observations")
    found = {"observations": observations}
    if isinstance(observations, h5py.Group):  # a dictionary; `visititems` skips links
        observations.visititems(lambda p, x: found.update({f"observations/{p}": x}))
    datasets = {path: x for path, x in found.items() if isinstance(x, h5py.Dataset)}
    images = [p for p, x in datasets.items() if _is_plain(x) or _is_jpeg(x)]
    if len(images) != 1:
        listed = ", ".join(f"{p} of {x.dtype} {x.shape}" for p, x in datasets.items())
        what = f"{len(images)} images, uint8 [H, W, 3], in an observation"
        raise FormatError(f"has {what}, not one: {listed}")
    return images[0]


def _is_plain(dataset: Any) -> bool:
    return dataset.dtype == np.uint8 and dataset.ndim == 4 and dataset.shape[3] == 3


def _is_jpeg(dataset: Any) -> bool:
    """Returns whether a dataset holds JPEGs: rows, or arrays of various lengths."""
    import h5py

    rows = dataset.dtype == np.uint8 and dataset.ndim == 2
    if not rows and not (dataset.ndim == 1 and h5py.check_vlen_dtype(dataset.dtype)):
        return False
    _check(dataset, ReadOptions(max_bytes=2**40))
    return len(dataset) > 0 and bytes(dataset[0][: len(_JPEG)]) == _JPEG


def _frames(dataset: Any, options: ReadOptions) -> np.ndarray:
    if not _is_plain(dataset) and _is_jpeg(dataset):
        _check(dataset, options)
        files = [np.asarray(row, np.uint8).tobytes() for row in dataset]
        return decode_pictures(files, options)
    return values(dataset, options)


def _actions(episode: Any, options: ReadOptions) -> np.ndarray | None:
    """Returns actions [T, A]; None for any other kind."""
    dataset = member(episode, "actions")
    if getattr(dataset, "dtype", np.dtype("O")).kind != "f" or dataset.ndim > 2:
        return None
    actions = values(dataset, options)
    return actions[:, None] if actions.ndim == 1 else actions


def values(
    dataset: Any, options: ReadOptions, rows: slice | tuple[()] = ()
) -> np.ndarray:
    """Returns the values of some rows, after `_check`."""
    _check(dataset, options, rows)
    return dataset[rows]


def _check(dataset: Any, options: ReadOptions, rows: slice | tuple[()] = ()) -> None:
    """Raises FormatError if the values are in another file, or too many."""
    if not hasattr(dataset, "dtype"):
        raise FormatError(f"has no numbers in {dataset.name}")
    name, plan = dataset.name, dataset.id.get_create_plist()
    if dataset.is_virtual or dataset.external:
        raise FormatError(f"stores {name} in another file")
    filters = {plan.get_filter(i)[0] for i in range(plan.get_nfilters())}
    if not filters <= _FILTERS:
        raise FormatError(f"has {name} with unsupported filters {sorted(filters)}")
    num_bytes = used_bytes = dataset.size * dataset.dtype.itemsize
    if isinstance(rows, slice):
        length = len(range(*rows.indices(len(dataset))))
        used_bytes = num_bytes * length // max(len(dataset), 1)
    options.check_bytes(f"{name} of shape {dataset.shape}", used_bytes)
    stored = dataset.id.get_storage_size()
    if num_bytes > stored * (_MAX_RATIO if filters else 1):
        raise FormatError(f"is damaged: {name} stores {stored} of {num_bytes} bytes")
