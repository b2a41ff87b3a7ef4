"""Damaged files of every foreign format: each is read, or refused with a sentence.

One child process per format does the reading, so that a crash or a hang of the
interpreter is a failed test. `JAXIL_FUZZ_MUTANTS=1000` reads that many mutants of each
format. What a failure names is repeated, alone, by

    python -m tests.demonstrations.test_readers_fuzz FORMAT FOLDER SEED SEED+1
"""

import faulthandler
import importlib
import io
import itertools
import os
import pathlib
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from jaxil.demonstrations.readers.recording import FormatError, PixelEpisode, Recording
from jaxil.demonstrations.readers.validation import check_episode
from tests.demonstrations import foreign_files

ROOT = pathlib.Path(__file__).parent.parent.parent
MAX_SECONDS = 5.0  # of computing, for one file
WAIT_FACTOR = 12  # how much longer it may take on a machine that is busy
MAX_RISE_BYTES = 2 * 1024**3  # of the memory, over that of reading a sound file
MAX_ARRAY_BYTES = 64 * 1024**2
MAX_FAILURES = 5
# As in all tests: a warning is an error, but for other packages' own affairs.
_THIS = "tests.demonstrations.test_readers_fuzz"
_READERS = "jaxil.demonstrations.readers"
_WARNINGS = ("-W", "error", "-W", "ignore::DeprecationWarning")


class Format(NamedTuple):
    """A format to try.

    Attributes:
      module: the reader's, in jaxil.demonstrations.readers.
      write: the function in foreign_files that writes a sound file or folder.
      num_variants: how many sound files are made, by seeds 0, 1, ...
      num_mutants: how many of their mutants are read if the environment doesn't say.
      libraries: what reader and writer need beyond this project's requirements.
    """

    module: str
    write: str
    num_variants: int
    num_mutants: int
    libraries: tuple[str, ...] = ()


FORMATS = {
    "own": Format("own", "write_own", 2, 100),
    "pickles": Format("pickles", "write_pickle", 16, 200),
    "replays": Format("replays", "write_replays", 4, 100),
    "videos": Format("videos", "write_video", 2, 6),
    "minari": Format("minari", "write_minari", 2, 10, ("h5py",)),
    "lerobot": Format("lerobot", "write_lerobot", 2, 6, ("pyarrow",)),
}


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(name, tmp_path):
    for library in FORMATS[name].libraries:
        pytest.importorskip(library)
    pytest.importorskip(f"{_READERS}.{FORMATS[name].module}")
    if not hasattr(foreign_files, FORMATS[name].write):
        pytest.skip(f"foreign_files has no {FORMATS[name].write} yet")
    num_mutants = os.environ.get("JAXIL_FUZZ_MUTANTS", FORMATS[name].num_mutants)
    child = run_child(name, tmp_path, 0, int(num_mutants))
    assert child.returncode == 0, report(child)


@pytest.mark.parametrize(
    ("fault", "trace"),
    [
        ("raises", "KeyError"),
        ("warns", "UserWarning"),
        ("computes for ever", "in open_recording"),
        ("waits for ever", "Timeout"),
        ("crashes", "Aborted"),
        ("fills the memory", "MemoryError"),
        ("holds less than it says", "AssertionError"),
    ],
)
def test_the_faults_of_a_reader_are_found(fault, trace, tmp_path):
    child = run_child(fault, tmp_path, 0, 4, max_seconds=0.25)
    assert child.returncode != 0
    assert trace in report(child)
    assert "seed 1" in child.stdout  # seed 0 is the sound file


def test_mutants_are_many_and_repeatable():
    content = bytes(range(256))
    mutants = [mutated(content, seed) for seed in range(1, 201)]
    assert mutants == [mutated(content, seed) for seed in range(1, 201)]
    assert len(set(mutants)) > 190
    assert min(map(len, mutants)) < 256 < max(map(len, mutants))
    assert mutated(b"", 1) is not None


def run_child(
    name: str, folder: pathlib.Path, first: int, last: int, max_seconds=MAX_SECONDS
) -> subprocess.CompletedProcess:
    """Reads the mutants of seeds first ... last - 1 in a process of its own."""
    arguments = [name, str(folder), str(first), str(last), str(max_seconds)]
    return subprocess.run(
        [
            sys.executable,
            *_WARNINGS,
            "-m",
            _THIS,
            *arguments,
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=60 + (last - first) * max_seconds * WAIT_FACTOR,
    )


def report(child: subprocess.CompletedProcess) -> str:
    return f"exit {child.returncode}\n{child.stdout[-3000:]}\n{child.stderr[-3000:]}"


# --- mutants --------------------------------------------------------------------------


def mutated_file(content: bytes, seed: int) -> bytes:
    """Returns a mutant of a file's content; half of the time, of what an archive holds.

    An archive's checksums would hide all damage within from those who read on.
    """
    rng = np.random.default_rng([seed, 1])
    if rng.random() < 0.5 or not zipfile.is_zipfile(io.BytesIO(content)):
        return mutated(content, seed)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = sorted(members)[rng.integers(len(members))]
    members[name] = mutated(members[name], seed)
    changed = io.BytesIO()
    with zipfile.ZipFile(changed, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return changed.getvalue()


def mutated(content: bytes, seed: int) -> bytes:
    """Returns `content` with one to three changes that follow from the seed."""
    rng = np.random.default_rng(seed)
    changed = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        if not changed:
            break
        _CHANGES[rng.integers(len(_CHANGES))](changed, rng)
    return bytes(changed)


def _flip_bits(content: bytearray, rng: np.random.Generator) -> None:
    for place in rng.integers(len(content), size=rng.integers(1, 5)):
        content[place] ^= 1 << rng.integers(8)


def _overwrite(content: bytearray, rng: np.random.Generator) -> None:
    begin, end = _piece(content, rng, 32)
    content[begin:end] = rng.bytes(end - begin)


def _cut_off(content: bytearray, rng: np.random.Generator) -> None:
    del content[rng.integers(len(content)) :]


def _cut_out(content: bytearray, rng: np.random.Generator) -> None:
    begin, end = _piece(content, rng, 32)
    del content[begin:end]


def _insert(content: bytearray, rng: np.random.Generator) -> None:
    begin, end = _piece(content, rng, 32)
    content[begin:begin] = rng.bytes(end - begin)


def _duplicate(content: bytearray, rng: np.random.Generator) -> None:
    begin, end = _piece(content, rng, 256)
    place = rng.integers(len(content))
    content[place:place] = content[begin:end]


def _zero_header(content: bytearray, rng: np.random.Generator) -> None:
    place = rng.integers(min(len(content), 64))
    content[place : place + 4] = bytes(len(content[place : place + 4]))


def _set_length(content: bytearray, rng: np.random.Generator) -> None:
    """Makes what may be a length the largest, or a small one that is not its own."""
    size = int(rng.choice([1, 2, 4, 8]))
    place = rng.integers(len(content))
    small = bytes([rng.integers(256)])
    fields = b"\xff" * size, small.ljust(size, b"\0"), small.rjust(size, b"\0")
    content[place : place + size] = fields[rng.integers(3)][: len(content) - place]


def _piece(
    content: bytearray, rng: np.random.Generator, longest: int
) -> tuple[int, int]:
    begin = int(rng.integers(len(content)))
    return begin, min(len(content), begin + int(rng.integers(1, longest + 1)))


_CHANGES: tuple[Callable[[bytearray, np.random.Generator], None], ...] = (
    _flip_bits,
    _overwrite,
    _cut_off,
    _cut_out,
    _insert,
    _duplicate,
    _zero_header,
    _set_length,
)


# --- the child ------------------------------------------------------------------------


def read_mutants(
    name: str, folder: pathlib.Path, first: int, last: int, max_seconds: float
) -> int:
    """Reads mutants, saying the seed before each; returns how many reads went wrong.

    A file of seed 0 is sound, and has to be read.
    """
    faulthandler.enable()
    # Says where it is, and then ends as nobody handles the signal.
    faulthandler.register(signal.SIGPROF, chain=True)
    if name in FORMATS:
        reader = importlib.import_module(f"{_READERS}.{FORMATS[name].module}")
        write = getattr(foreign_files, FORMATS[name].write)
        num_variants = FORMATS[name].num_variants
    else:
        reader, write, num_variants = FaultyReader(name), foreign_files.write_pickle, 1
    for variant in range(num_variants):
        if not (folder / f"sound{variant}").exists():
            (folder / f"sound{variant}").mkdir(parents=True)
            write(folder / f"sound{variant}" / "data", variant)
    read_whole(reader, folder / "sound0" / "data")
    limit_memory()
    num_failures = 0
    for seed in range(first, last):
        shutil.rmtree(folder / "mutant", ignore_errors=True)
        shutil.copytree(folder / f"sound{seed % num_variants}", folder / "mutant")
        path = folder / "mutant" / "data"
        if seed > 0:
            inside = sorted((folder / "mutant").rglob("*"))
            files = [file for file in inside if file.is_file()]
            file = files[np.random.default_rng(seed).integers(len(files))]
            file.write_bytes(mutated_file(file.read_bytes(), seed))
        print(f"seed {seed}", flush=True)
        start = seconds_computed()
        signal.setitimer(signal.ITIMER_PROF, max_seconds)
        faulthandler.dump_traceback_later(max_seconds * WAIT_FACTOR, exit=True)
        try:
            outcome = f"read {read_whole(reader, path)}"
        except (FormatError, OSError) as error:
            outcome = f"refused: {error}"
            num_failures += seed == 0
        except BaseException:
            outcome = f"WRONG: {traceback.format_exc()}"
            num_failures += 1
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_PROF, 0)
        seconds = seconds_computed() - start
        if seconds > max_seconds:  # in programs that the reader started
            outcome = f"WRONG: more than {max_seconds} s"
            num_failures += 1
        print(f"  {seconds:.2f} s, {outcome}"[-2000:])
        if num_failures >= MAX_FAILURES:
            break
    return num_failures


def read_whole(reader: Any, path: pathlib.Path) -> int:
    """Reads all of a file; returns how many episodes it holds."""
    assert reader.recognises(path) in (True, False)
    recording = reader.open_recording(path, max_bytes=MAX_ARRAY_BYTES)
    index = -1
    for index, episode in enumerate(recording.episodes):
        check_episode(index, episode)
        assert episode.frames.nbytes <= MAX_ARRAY_BYTES
    assert index + 1 == recording.num_episodes > 0
    return recording.num_episodes


def seconds_computed() -> float:
    """Returns the processor's time that this process and its children took."""
    times = os.times()
    return sum(times[:4])


def limit_memory() -> None:
    """Makes an allocation that is far larger than the files a MemoryError."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MAX_RISE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


class FaultyReader:
    """Reads nothing, and does worse with any file but the first that it is shown."""

    def __init__(self, fault: str):
        self._fault = fault
        self._sound: bytes | None = None

    def recognises(self, path: pathlib.Path) -> bool:
        return True

    def open_recording(self, path: pathlib.Path, *, max_bytes: int) -> Recording:
        content = path.read_bytes()
        self._sound = self._sound or content
        num_episodes = 1
        if content != self._sound:
            if self._fault == "raises":
                raise KeyError("x")
            if self._fault == "warns":
                warnings.warn("x", stacklevel=1)
            if self._fault == "computes for ever":
                sum(itertools.repeat(0))  # in C, without a look at signals
            if self._fault == "waits for ever":
                time.sleep(1000)
            if self._fault == "crashes":
                os.abort()
            if self._fault == "fills the memory":
                np.zeros(MAX_RISE_BYTES)
            num_episodes = 2
        episode = PixelEpisode(np.zeros((2, 1, 1, 3), np.uint8))
        return Recording("faulty", num_episodes, iter([episode]))


if __name__ == "__main__":
    _name, _folder, _first, _last, *_seconds = sys.argv[1:]
    _num_failures = read_mutants(
        _name,
        pathlib.Path(_folder),
        first=int(_first),
        last=int(_last),
        max_seconds=float(_seconds[0]) if _seconds else MAX_SECONDS,
    )
    sys.exit(_num_failures > 0)
