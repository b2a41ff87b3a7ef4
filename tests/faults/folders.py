"""Run folders with one fault each: every reader reads on, or refuses with a sentence.

A fault is damage to a file's content, or a file that is gone, empty, exchanged, or
replaced by a folder, a pipe or a link to itself. Whatever it is, the learner's state
must come back as it was saved: there are two checkpoints, and one fault.
"""

import os
import pathlib
import shutil
from collections.abc import Iterator

import numpy as np

from jaxil.errors import UsageError
from jaxil.files.tables import CsvLog, read_csv
from jaxil.reporting import episodes, groups, runs
from jaxil.sweeps import state
from jaxil.training import workdir
from jaxil.training.checkpoint import Checkpoints
from tests.demonstrations.test_readers_fuzz import mutated_file
from tests.reporting.run_folders import film, write_run
from tests.training import saved_runs as saved

FRAMES = (1000, 2000)
_GROUPS = ("config.json", "eval.csv", "train.csv", "videos", "replay", "checkpoints")
_MOST_LETTERS = 2000  # of a message


def outcomes(folder: pathlib.Path, count: int, seed: int) -> Iterator[str]:
    """Yields "" for each folder with which all went well, else what did not."""
    sound = write_run(
        folder / "sound",
        "psil",
        "walker_walk",
        0,
        {1000: 10, 2000: 20, 3000: 30},
        logits=True,
    )
    film(sound, 3000, plan=True)
    checkpoints, replay = Checkpoints(sound), saved.make_replay()
    for frame in FRAMES:
        saved.add_episodes(replay, 1)
        saved.save(checkpoints, frame, replay, saved_at=frame)
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        spoilt = folder / "spoilt"
        shutil.rmtree(spoilt, ignore_errors=True)
        shutil.copytree(sound, spoilt)
        what = _spoil(spoilt, rng)
        try:
            for message in _read(spoilt):
                assert message.isprintable(), "a control character"
                assert len(message) <= _MOST_LETTERS, "a long message"
            yield ""
        except Exception as error:
            yield f"{what}: {type(error).__name__}: {str(error)[:300]}"


def _spoil(folder: pathlib.Path, rng: np.random.Generator) -> str:
    """Makes one fault; returns what it is."""
    group = folder / str(rng.choice(_GROUPS))
    files = sorted(p for p in (group, *group.rglob("*")) if p.is_file())
    file = files[rng.integers(len(files))]
    content = file.read_bytes()
    how = str(rng.choice(["damage"] * 12 + _OTHER_FAULTS))
    match how:
        case "damage":
            file.write_bytes(mutated_file(content, int(rng.integers(2**31))))
        case "empty":
            file.write_bytes(b"")
        case "brackets":
            file.write_bytes(b"[" * 200_000)
        case "exchanged":
            # Of one checkpoint: else both are damaged.
            place = file.relative_to(folder).parts[: 2 if group.is_dir() else 1]
            near = [p for p in files if p.relative_to(folder).parts[:2] == place]
            others = files if group.name == "replay" else near
            other = others[rng.integers(len(others))]
            file.write_bytes(other.read_bytes())
            other.write_bytes(content)
        case "stray":
            file.with_name(".DS_Store").write_bytes(rng.bytes(100))
        case "gone" | "folder" | "pipe" | "link":
            file.unlink()
            if how == "folder":
                file.mkdir()
            elif how == "pipe":
                os.mkfifo(file)
            elif how == "link":
                file.symlink_to(file)
    return f"{how} {file.relative_to(folder)}"


_OTHER_FAULTS = ["empty", "brackets", "exchanged", "stray"]
_OTHER_FAULTS += ["gone", "folder", "pipe", "link"]


def _read(folder: pathlib.Path) -> Iterator[str]:
    """Reads a folder as all commands do; yields what they say."""
    try:
        run = runs.read(folder)
        yield from run.remarks
        yield from episodes.collect(groups.make_groups([run]), 1)[1]
    except runs.UnreadableError as error:
        yield str(error)
    try:
        workdir.read_config(folder)
    except UsageError as error:
        yield str(error)
    swept = state.Run("walker_walk", "psil", "psil", 0, folder, 3000, ())
    state.status(swept)
    yield state.damage(swept)
    said: list[str] = []
    if (folder / "config.json").is_file():
        log = CsvLog(
            folder / "train.csv",
            ("frame", "seconds"),
            resume_frame=1500,
            say=said.append,
        )
        log.append({"frame": 2000, "seconds": 1})
        assert read_csv(folder / "train.csv")["frame"][-1] == 2000
    yield from said
    yield from _restore(folder)


def _restore(folder: pathlib.Path) -> list[str]:
    """Compares what is restored with what was saved; returns what was said."""
    _, restored, learner, counters, said = saved.restore(folder)
    saved.assert_same_state(saved.make_state(counters["saved_at"]), learner)
    expected = saved.make_replay(FRAMES.index(counters["saved_at"]) + 1)
    for index in restored.episodes:
        pairs = zip(expected.episode(index), restored.episode(index), strict=True)
        for ours, theirs in pairs:
            np.testing.assert_array_equal(ours, theirs)
    left_out = set(expected.episodes) - set(restored.episodes)
    assert not left_out or said, "an episode is left out silently"
    return said
