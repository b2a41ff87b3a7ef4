"""jaxil's own format of pixels, to which all others can be converted.

A NumPy archive (.npz) of K episodes, k = 0 ... K - 1:

    frames_k    uint8 [N_k + 1, H, W, 3]
    actions_k   float32 [N_k, A], if known
    rewards_k   float32 [N_k], if known
    metadata    JSON text, see `write_pixels`
"""

import json
import os
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    ReadOptions,
    Recording,
    naming,
)
from jaxil.files import archive

FORMAT = "jaxil-pixels"
VERSION = 1
_MAX_METADATA_BYTES = 1024**2
_MAX_NUMBER = 10**9  # of an action repeat or frame rate; its inverse is the least
_OPTIONAL = {"task": str, "action_repeat": int, "frames_per_second": float}


def write_pixels(path: str | os.PathLike, recording: Recording, *, origin: str) -> None:
    """Writes a recording atomically, consuming its episodes one at a time.

    `origin` says where the pixels come from.
    """
    metadata = {
        "format": FORMAT,
        "version": VERSION,
        "origin": origin,
        **{name: getattr(recording, name) for name in _OPTIONAL},
    }

    def arrays() -> Iterator[tuple[str, np.ndarray]]:
        for index, episode in enumerate(recording.episodes):
            yield f"frames_{index}", episode.frames
            if episode.actions is not None:
                yield f"actions_{index}", episode.actions.astype(np.float32)
            if episode.rewards is not None:
                yield f"rewards_{index}", episode.rewards.astype(np.float32)
        yield "metadata", np.array(json.dumps(metadata))

    archive.write_archive(pathlib.Path(path), arrays())


def recognises(path: pathlib.Path) -> bool:
    """Returns whether a file has this format, by the names of its arrays."""
    names = archive.member_names(path)
    return "metadata" in names and "frames_0" in names


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads a file of `write_pixels`."""
    with naming(path, path):
        metadata = _read_metadata(path)
    stored = archive.member_names(path)
    num_episodes = sum(name.startswith("frames_") for name in stored)
    yield Recording(
        kind="jaxil pixels",
        num_episodes=num_episodes,
        origin=metadata["origin"],
        **{name: metadata[name] for name in _OPTIONAL},
    )
    with naming(path, path), archive.opened(path) as reader:
        for index in range(num_episodes):
            names = {k: f"{k}_{index}" for k in ("frames", "actions", "rewards")}
            names = {k: v for k, v in names.items() if k == "frames" or v in stored}
            arrays = reader.read(dict.fromkeys(names.values(), options.max_bytes))
            known = {name: arrays[names[name]] for name in names}
            yield PixelEpisode(stored_size=None, **known)


def _read_metadata(path: pathlib.Path) -> dict[str, Any]:
    text = archive.read_archive(path, max_bytes={"metadata": _MAX_METADATA_BYTES})
    try:
        metadata = json.loads(str(text["metadata"]))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"has metadata that are not JSON ({error})") from error
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise FormatError("has metadata that lack the format name")
    if metadata.get("version") != VERSION:
        version = metadata.get("version")
        raise FormatError(f"has version {version!r} of the format, not {VERSION}")
    for name, kind in _OPTIONAL.items():
        value = metadata.get(name)
        if value is not None and (not isinstance(value, kind) or not value):
            raise FormatError(f"has metadata {name}={value!r}, not {kind.__name__}")
        is_number = isinstance(value, int | float)
        if is_number and not 1 / _MAX_NUMBER <= value <= _MAX_NUMBER:
            limits = f"[{1 / _MAX_NUMBER:g}, {_MAX_NUMBER:g}]"
            raise FormatError(f"has metadata {name}={value!r:.50}, not in {limits}")
    if not isinstance(metadata.get("origin"), str):
        raise FormatError("has metadata without origin")
    return {**dict.fromkeys(_OPTIONAL), **metadata}
