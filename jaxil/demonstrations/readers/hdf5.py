"""V-D4RL's HDF5 files: whole episodes end to end in flat arrays.

    observation  uint8 [T, 3 n, H, W] or [T, H, W, 3 n], the newest of n frames last
    action       [T, A]; action t precedes observation t
    reward       [T]; as the action
    step_type    [T]; 0 for the reset of an episode

Source: conglu1997/v-d4rl, drqbc/utils.py.
"""

import itertools
import pathlib
from collections.abc import Iterator

import numpy as np

from jaxil.demonstrations.readers import minari
from jaxil.demonstrations.readers.frames import newest_frames
from jaxil.demonstrations.readers.recording import (
    FormatError,
    Item,
    PixelEpisode,
    ReadOptions,
    Recording,
    naming,
)

_NAMES = ("observation", "action", "reward", "step_type")


def recognises(path: pathlib.Path) -> bool:
    """Returns whether this is an HDF5 file, or a folder of them."""
    return bool(_files(path))


def read(path: pathlib.Path, options: ReadOptions) -> Iterator[Item]:
    """Reads the files of a folder in order of name."""
    try:
        import h5py
    except ImportError:
        raise FormatError("needs h5py: pip install h5py") from None
    files, starts = _files(path), {}
    for file in files:
        with naming(file, path), h5py.File(file, "r", locking=False) as content:
            missing = [name for name in _NAMES if name not in content]
            if missing:
                raise FormatError(f"is not of V-D4RL: it lacks {', '.join(missing)}")
            types = minari.values(minari.member(content, "step_type"), options)
            if types.ndim != 1 or len(types) < 2 or types[0] != 0:
                raise FormatError("has a step_type that does not start with a reset")
            starts[file] = np.append(np.flatnonzero(types == 0), len(types))
    yield Recording("V-D4RL", sum(len(each) - 1 for each in starts.values()))
    for file in files:
        with naming(file, path), h5py.File(file, "r", locking=False) as content:
            arrays = [minari.member(content, name) for name in _NAMES[:3]]
            lengths = {len(array) for array in arrays}
            if lengths != {starts[file][-1]}:
                raise FormatError(f"has arrays of different lengths: {sorted(lengths)}")
            for begin, end in itertools.pairwise(starts[file]):
                images, actions, rewards = (
                    minari.values(array, options, slice(begin, end)) for array in arrays
                )
                yield PixelEpisode(newest_frames(images), actions[1:], rewards[1:])


def _files(path: pathlib.Path) -> list[pathlib.Path]:
    try:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
    except (OSError, ValueError):
        return []
    return [file for file in files if minari.is_hdf5(file)]
