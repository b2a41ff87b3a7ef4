"""Damaged files of every foreign format: each is read, or refused with one line.

A child process does the reading, so that a crash, a hang or an allocation without
bounds is a failed test. `JAXIL_FUZZ_MUTANTS=1000` reads that many files of each format.
"""

import io
import os
import pathlib
import shutil
import zipfile
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers.recording import FormatError
from jaxil.machine.child import ChildError, results
from tests.demonstrations import foreign_files

MAX_BYTES = 64 * 1024**2
LIMITS: dict = {
    "seconds": 300.0,
    "cpu_seconds": 30,
    "memory_bytes": 2 * 1024**3,
    "result_bytes": 1024**3,
}


class Format(NamedTuple):
    """A format to try; seeds below `num_variants` write different valid files."""

    write: str
    num_variants: int
    num_mutants: int
    library: str = "numpy"


FORMATS = {
    "own": Format("write_own", 2, 60),
    "pickles": Format("write_pickle", 16, 16),
    "replays": Format("write_replays", 4, 60),
    "pictures": Format("write_pictures", 2, 20),
    "hdf5": Format("write_hdf5", 2, 8, "h5py"),
    "videos": Format("write_video", 2, 8),
    "minari": Format("write_minari", 2, 8, "minari"),
    "lerobot": Format("write_lerobot", 2, 6, "pyarrow"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(name, tmp_path):
    pytest.importorskip(FORMATS[name].library)
    num_mutants = os.environ.get("JAXIL_FUZZ_MUTANTS", FORMATS[name].num_mutants)
    outcomes = []
    try:
        child = results(read_mutants, name, tmp_path, int(num_mutants), **LIMITS)
        for outcome in child:
            outcomes.append(outcome)
    except ChildError as error:
        pytest.fail(f"mutant {len(outcomes)} of {name}: {error}")
    assert outcomes[0].startswith("read"), outcomes[0]
    assert any(outcome.startswith("refused") for outcome in outcomes)
    assert not any("\n" in outcome or "\x1b" in outcome for outcome in outcomes)


def read_mutants(
    name: str, folder: pathlib.Path, num_files: int, first_seed: int = 1
) -> Iterator[str]:
    """Yields what became of each file; the first is valid, the others are mutants."""
    form = FORMATS[name]
    for variant in range(form.num_variants):
        (folder / f"valid{variant}").mkdir()
        write = getattr(foreign_files, form.write)
        write(folder / f"valid{variant}" / "data", variant)
    for seed in (0, *range(first_seed, first_seed + num_files - 1)):
        shutil.rmtree(folder / "mutant", ignore_errors=True)
        shutil.copytree(folder / f"valid{seed % form.num_variants}", folder / "mutant")
        if seed > 0:
            parts = sorted((folder / "mutant").rglob("*"))
            files = [part for part in parts if part.is_file()]
            file = files[np.random.default_rng(seed).integers(len(files))]
            file.write_bytes(mutated_file(file.read_bytes(), seed))
        try:
            recording = foreign.open_recording(
                folder / "mutant" / "data", max_bytes=MAX_BYTES
            )
            episodes = list(recording.episodes)
        except (FormatError, OSError) as error:
            yield f"refused: {error}"
        else:
            assert len(episodes) == recording.num_episodes > 0
            assert max(episode.frames.nbytes for episode in episodes) <= MAX_BYTES
            yield f"read {len(episodes)} episodes"


def mutated_file(content: bytes, seed: int) -> bytes:
    """Returns a mutant of a file's content.

    Of an archive, half the time, one member is changed and all are packed again:
    otherwise its checksums would keep readers from ever seeing the damage.
    """
    rng = np.random.default_rng([seed, 1])
    if rng.random() < 0.5 or not zipfile.is_zipfile(io.BytesIO(content)):
        return mutated(content, rng)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = sorted(members)[rng.integers(len(members))]
    members[name] = mutated(members[name], rng)
    changed = io.BytesIO()
    with zipfile.ZipFile(changed, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return changed.getvalue()


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Returns `content` with one to three pieces changed."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        begin = int(rng.integers(len(changed) + 1))
        end = min(len(changed), begin + int(rng.integers(1, 33)))
        match rng.integers(7):
            case 0:  # flip a bit
                changed[begin : begin + 1] = bytes(
                    byte ^ (1 << rng.integers(8)) for byte in changed[begin : begin + 1]
                )
            case 1:  # overwrite
                changed[begin:end] = rng.bytes(end - begin)
            case 2:  # cut off
                del changed[begin:]
            case 3:  # cut out
                del changed[begin:end]
            case 4:  # insert
                changed[begin:begin] = rng.bytes(end - begin)
            case 5:  # repeat
                changed[begin:begin] = changed[begin:end]
            case 6:  # what may be a length becomes the largest, or a small one
                size = min(int(rng.choice([1, 2, 4, 8])), len(changed) - begin)
                small = bytes([rng.integers(256)]) + bytes(8)
                changed[begin : begin + size] = (b"\xff" * 8, small)[rng.integers(2)][
                    :size
                ]
    return bytes(changed)


def test_mutants_are_many_and_repeatable():
    content = bytes(range(256))
    mutants = [mutated_file(content, seed) for seed in range(1, 201)]
    assert mutants == [mutated_file(content, seed) for seed in range(1, 201)]
    assert len(set(mutants)) > 180
    assert min(map(len, mutants)) < 256 < max(map(len, mutants))
    assert mutated_file(b"", 1) is not None
