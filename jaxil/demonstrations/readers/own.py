"""jaxil's own file of pixels, into which every other format can be converted.

A NumPy archive (.npz) of K episodes, of lengths of their own:

    frames_k    uint8 [N_k + 1, H, W, 3], for k = 0 ... K - 1
    actions_k   float32 [N_k, A], only if they are known
    rewards_k   float32 [N_k], only if they are known
    metadata    a JSON text, see `write_pixels`
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
_OPTIONAL = {"task": str, "action_repeat": int, "frames_per_second": float}


def write_pixels(path: str | os.PathLike, recording: Recording, *, origin: str) -> None:
    """Writes a recording, whole or not at all, an episode at a time.

    Args:
      path: the file.
      recording: its episodes are used up.
      origin: where the pixels come from, for people.

    Raises:
      FormatError: an episode of the recording cannot be read.
      OSError: the file cannot be written.
    """
    metadata: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "origin": origin,
        "num_episodes": recording.num_episodes,
        "has_actions": [],
        "has_rewards": [],
        **{name: getattr(recording, name) for name in _OPTIONAL},
    }

    def arrays() -> Iterator[tuple[str, np.ndarray]]:
        for index, episode in enumerate(recording.episodes):
            yield f"frames_{index}", episode.frames
            metadata["has_actions"].append(episode.actions is not None)
            metadata["has_rewards"].append(episode.rewards is not None)
            if episode.actions is not None:
                yield f"actions_{index}", episode.actions.astype(np.float32)
            if episode.rewards is not None:
                yield f"rewards_{index}", episode.rewards.astype(np.float32)
        yield "metadata", np.array(json.dumps(metadata))

    archive.write_archive(pathlib.Path(path), arrays())


def recognises(path: pathlib.Path) -> bool:
    """Tells whether `path` is a file of this format, as far as its names tell."""
    names = archive.member_names(path)
    return "metadata" in names and "frames_0" in names


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads a file of `write_pixels`; see `recording`."""
    with naming(path, path):
        metadata = _read_metadata(path)
    yield Recording(
        kind="jaxil pixels",
        num_episodes=metadata["num_episodes"],
        notes=(f"Made from: {metadata['origin']}.",),
        **{name: metadata[name] for name in _OPTIONAL},
    )
    for index in range(metadata["num_episodes"]):
        names = {"frames": f"frames_{index}"}
        for name in ("actions", "rewards"):
            if metadata[f"has_{name}"][index]:
                names[name] = f"{name}_{index}"
        limits = dict.fromkeys(names.values(), options.max_bytes)
        with naming(path, path):
            arrays = archive.read_archive(path, max_bytes=limits)
        known = {name: arrays[stored] for name, stored in names.items()}
        yield PixelEpisode(stored_size=None, **known)


def _read_metadata(path: pathlib.Path) -> dict[str, Any]:
    text = archive.read_archive(path, max_bytes={"metadata": _MAX_METADATA_BYTES})
    try:
        metadata = json.loads(str(text["metadata"]))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"has metadata that are not JSON ({error})") from error
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise FormatError("has frames, but metadata that lack the format's name")
    if metadata.get("version") != VERSION:
        raise FormatError(
            f"has version {metadata.get('version')!r} of the format, where this "
            f"program reads version {VERSION}"
        )
    num_episodes = metadata.get("num_episodes")
    for name in ("has_actions", "has_rewards"):
        flags = metadata.get(name)
        if (
            not isinstance(num_episodes, int)
            or not isinstance(flags, list)
            or len(flags) != num_episodes
            or num_episodes < 1
        ):
            raise FormatError(
                f"has metadata {name}={flags!r}, which do not fit "
                f"num_episodes={num_episodes!r}"
            )
    for name, kind in _OPTIONAL.items():
        value = metadata.get(name)
        if value is not None and (not isinstance(value, kind) or not value):
            raise FormatError(
                f"has metadata {name}={value!r}, where {kind.__name__} is expected"
            )
    if not isinstance(metadata.get("origin"), str):
        raise FormatError("has metadata without origin")
    return {**dict.fromkeys(_OPTIONAL), **metadata}
