"""Replay folders of DrQ-v2 and DreamerV2, including V-D4RL.

Each `.npz` file is one episode of T entries, of which the first is the reset:

    DrQ-v2      observation   uint8 [T, 3 n, H, W], n stacked frames, the newest last
                reward        [T, 1]
    DreamerV2,  image         uint8 [T, H, W, 3]
    V-D4RL      reward        [T]
                is_first      [T], true for the reset; older files lack it
    both        action        [T, A], all 0 for the reset

Action and reward t precede observation t, so those of the reset are dropped. Names in
the archives are never used as paths.

Source: facebookresearch/drqv2, replay_buffer.py and dmc.py; danijar/dreamerv2,
common/driver.py and common/replay.py; conglu1997/v-d4rl, hdf5_to_npz.py, with the data
from philipjball/SAC_PyTorch, dmc.py.
"""

import pathlib
from collections.abc import Iterator

import numpy as np

from jaxil.demonstrations.readers.frames import newest_frames
from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    ReadOptions,
    Recording,
    checked_episode,
    naming,
)
from jaxil.files import archive

_KINDS = {"image": "DreamerV2 or V-D4RL replay", "observation": "DrQ-v2 replay"}
_MAX_FLAG_BYTES = 16 * 1024**2


def recognises(path: pathlib.Path) -> bool:
    """Returns whether this is an episode or a folder with one, by array names."""
    try:
        return any(_frames_name(archive.member_names(file)) for file in _files(path))
    except (OSError, ValueError):
        return False


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads a replay's folder in order of file names, or one file of it."""
    kinds = {}
    files = list(_files(path))
    for file in files:
        with naming(file, path):
            names = archive.member_names(file)
            if not names:
                raise FormatError("is cut off, damaged or no .npz file")
        if frames_name := _frames_name(names):
            kinds[file] = _KINDS[frames_name]
    if not kinds:
        arrays = "observation or image, action and reward"
        raise FormatError(f"holds no episodes: no .npz file with arrays {arrays}")
    notes = ()
    if len(kinds) < len(files):
        num_others = len(files) - len(kinds)
        notes = (f"{num_others} of its {len(files)} .npz files are not episodes.",)
    yield Recording(" and ".join(sorted(set(kinds.values()))), len(kinds), notes=notes)
    for index, file in enumerate(kinds):
        with naming(file, path):
            episode = checked_episode(index, _read_file(file, options.max_bytes))
        yield episode


def _files(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields the file, or those of a folder that may be episodes."""
    if path.is_dir():
        for file in sorted(path.iterdir()):
            if file.suffix == ".npz" and file.is_file():
                yield file
    elif path.is_file():
        yield path


def _frames_name(names: frozenset[str]) -> str:
    """Returns the name of an episode's frames; "" for other files, jaxil's included."""
    if not {"action", "reward"} <= names or names & {"qpos", "metadata"}:
        return ""
    return next((name for name in _KINDS if name in names), "")


def _read_file(file: pathlib.Path, max_bytes: int) -> PixelEpisode:
    names = archive.member_names(file)
    frames_name = _frames_name(names)
    limits = dict.fromkeys((frames_name, "action", "reward"), max_bytes)
    if "is_first" in names:
        limits["is_first"] = min(max_bytes, _MAX_FLAG_BYTES)
    arrays = archive.read_archive(file, max_bytes=limits)
    shapes = {name: array.shape for name, array in arrays.items()}
    lengths = {shape[:1] for shape in shapes.values()}
    if len(lengths) > 1 or min(lengths) < (2,):
        raise FormatError(f"has arrays of different lengths or too short: {shapes}")
    if "is_first" in arrays and np.any(arrays["is_first"][1:]):
        raise FormatError("holds more than one episode: is_first is true again")
    # DreamerV3's chunks have the same names, but action t follows observation t.
    if "stepid" in names or np.any(arrays["action"][0]):
        raise FormatError(
            "begins with a nonzero action, so it seems to pair actions and "
            "observations differently from DrQ-v2 and DreamerV2"
        )
    frames = newest_frames(arrays[frames_name])
    return PixelEpisode(frames, arrays["action"][1:], arrays["reward"][1:])
