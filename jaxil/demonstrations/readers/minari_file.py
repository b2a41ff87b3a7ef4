"""The program that reads a Minari dataset's HDF5 file, in a process of its own.

HDF5's library computes for ever on one in a thousand files with damaged bytes; here it
can be stopped. It opens no other file, however the format may refer to one.
"""

import pathlib
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxil.demonstrations.readers import messages, pictures
from jaxil.demonstrations.readers.messages import Message
from jaxil.demonstrations.readers.recording import FormatError

_MAX_DEPTH, _MAX_ENTRIES = 4, 1000  # of an observation's dictionary
_FILTERS = {1, 2, 3, 32000}  # gzip, shuffle, fletcher32, lzf: no plug-ins
_MAX_RATIO = 1100  # unpacked to packed; gzip, the tightest of them, reaches 1032
_JPEG = b"\xff\xd8\xff"


def read(path: pathlib.Path, *, max_bytes: int) -> Iterator[Message]:
    """Yields the number of episodes with notes, and then each episode.

    Args:
      path: the file.
      max_bytes: of any one array.
    """
    import h5py

    pictures.prepare()
    with h5py.File(path, "r", locking=False) as file:
        messages.open_no_more_files()
        found = [re.fullmatch(r"episode_(\d{1,9})", str(name)) for name in file]
        numbers = sorted(int(match[1]) for match in found if match is not None)
        if not numbers or numbers != list(range(len(numbers))):
            raise FormatError("has no episodes that are numbered from 0 on")
        first = _member(file, "episode_0")
        image = _image_in(first)
        notes = []
        if _is_jpeg(_follow(first, image)):
            notes.append("Its images were stored as JPEG, which changes them slightly.")
        if _actions(first, max_bytes) is None:
            notes.append("Its actions are no vectors of real numbers, and not read.")
        yield Message({"num_episodes": len(numbers), "notes": notes}, {})
        for number in numbers:
            episode = _member(file, f"episode_{number}")
            yield Message({}, _arrays(number, episode, image, max_bytes))


def _arrays(
    number: int, episode: Any, image: tuple[str, ...], max_bytes: int
) -> dict[str, np.ndarray]:
    """Returns the fields of a PixelEpisode."""
    frames = _frames(_follow(episode, image), max_bytes)
    rewards = _values(_member(episode, "rewards"), max_bytes)
    if rewards.ndim != 1 or rewards.dtype.kind not in "fiub":
        raise FormatError(f"has rewards of type {rewards.dtype} {rewards.shape}")
    arrays = {"rewards": rewards.astype(np.float32)}
    actions = _actions(episode, max_bytes)
    if actions is not None:
        arrays["actions"] = actions
    if not len(rewards) or any(len(x) != len(frames) - 1 for x in arrays.values()):
        lengths = {name: len(array) for name, array in arrays.items()}
        raise FormatError(
            f"has {len(frames)} images in episode {number}, which don't fit {lengths}"
        )
    return {"frames": frames, **arrays}


def _member(group: Any, name: str) -> Any:
    """Returns a group or dataset that lies in this file."""
    import h5py

    if name not in group:
        raise FormatError(f"has no {name} in {group.name}")
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise FormatError(f"has a link in the place of {name}")
    return group[name]


def _follow(episode: Any, names: tuple[str, ...]) -> Any:
    for name in names:
        episode = _member(episode, name)
    return episode


def _image_in(episode: Any) -> tuple[str, ...]:
    """Returns the names that lead to the one image of an observation."""
    images, others = [], []

    def look(names: tuple[str, ...], depth: int) -> None:
        import h5py

        member = _follow(episode, names)
        if isinstance(member, h5py.Group):
            if depth > _MAX_DEPTH or len(member) > _MAX_ENTRIES:
                raise FormatError("has observations that are nested too deeply")
            for name in member:
                look((*names, str(name)), depth + 1)
        elif _is_jpeg(member) or _is_plain(member):
            images.append(names)
        else:
            others.append(f"{'/'.join(names)} of {member.dtype} {member.shape}")

    look(("observations",), 0)
    if len(images) > 1:
        listed = ", ".join("/".join(names[1:]) for names in images[:10])
        raise FormatError(
            f"has {len(images)} images in an observation, not one: {listed}"
        )
    if not images:
        raise FormatError(
            "has no image of type uint8 and shape [H, W, 3] in its observations: "
            + ", ".join(others[:10])
        )
    return images[0]


def _is_plain(dataset: Any) -> bool:
    return dataset.dtype == np.uint8 and dataset.ndim == 4 and dataset.shape[3] == 3


def _is_jpeg(dataset: Any) -> bool:
    """Tells whether these are JPEGs: rows, or arrays where lengths are not equal."""
    import h5py

    rows = dataset.dtype == np.uint8 and dataset.ndim == 2
    if not rows and not (dataset.ndim == 1 and h5py.check_vlen_dtype(dataset.dtype)):
        return False
    _check(dataset, 2**40)
    return len(dataset) > 0 and bytes(dataset[0][: len(_JPEG)]) == _JPEG


def _frames(dataset: Any, max_bytes: int) -> np.ndarray:
    """Returns the images of an episode. Shape [T + 1, H, W, 3]."""
    if _is_plain(dataset):
        return _values(dataset, max_bytes)
    if not _is_jpeg(dataset):
        raise FormatError(f"has images of type {dataset.dtype} {dataset.shape}")
    _check(dataset, max_bytes)
    files = [np.asarray(row, np.uint8).tobytes() for row in dataset]
    return pictures.decode_pictures(files, max_bytes=max_bytes)


def _actions(episode: Any, max_bytes: int) -> np.ndarray | None:
    """Returns actions as float32 [T, A]; None where they are something else."""
    import h5py

    dataset = _member(episode, "actions")
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind != "f":
        return None
    if dataset.ndim not in (1, 2):
        return None
    with np.errstate(all="ignore"):  # too large a number becomes infinite
        values = _values(dataset, max_bytes).astype(np.float32)
    return values[:, None] if values.ndim == 1 else values


def _values(dataset: Any, max_bytes: int) -> np.ndarray:
    """Returns all of a dataset."""
    import h5py

    if not isinstance(dataset, h5py.Dataset):
        raise FormatError(f"has no numbers in {dataset.name}")
    _check(dataset, max_bytes)
    return dataset[()]


def _check(dataset: Any, max_bytes: int) -> None:
    """Raises FormatError where a dataset's values lie elsewhere, or are too many."""
    name, plan = dataset.name, dataset.id.get_create_plist()
    if dataset.is_virtual or dataset.external:
        raise FormatError(f"keeps {name} in another file")
    filters = {plan.get_filter(i)[0] for i in range(plan.get_nfilters())}
    if not filters <= _FILTERS:
        raise FormatError(f"has {name} packed by unknown filters {sorted(filters)}")
    num_bytes = dataset.size * dataset.dtype.itemsize
    if num_bytes > max_bytes:
        raise FormatError(
            f"has {name} of shape {dataset.shape}, {num_bytes} bytes, more than the "
            f"{max_bytes} that are accepted"
        )
    stored = dataset.id.get_storage_size()
    if num_bytes > stored * (_MAX_RATIO if filters else 1):
        raise FormatError(
            f"is damaged: {name} has {num_bytes} bytes, but only {stored} are stored"
        )


if __name__ == "__main__":
    messages.serve(read)
