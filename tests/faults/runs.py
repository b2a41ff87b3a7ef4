"""Runs that are killed, stopped or out of disk, and then resumed: bit for bit.

    python -m tests.faults.runs killed pdac 50 0 FOLDER

Prints a line for each fault, empty if the resumed run repeated the unbroken one. The
environment is the drawing of tests/training/test_updates.py; the learner, with the
encoder in C, and all files are real.
"""

import contextlib
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np

from jaxil.machine import startup
from jaxil.machine.signals import StopOnSignals
from jaxil.training import agent as agents
from jaxil.training import assembly, learning_curve, parts
from jaxil.training.workdir import RunFolderError
from tests.environments.counting import InTurn
from tests.training import test_updates as runs

_MAKE_CONFIG = runs.make_config


def make_config(method: str, **changes: Any) -> Any:
    """Returns the small config of the tests, with the encoder in C."""
    config = _MAKE_CONFIG(method, reward_refresh_steps=runs.STEPS + 5, **changes)
    config.encoder.channels = (32, 32)
    config.encoder.convolutions = "native"
    return config


def replace_what_is_slow() -> None:
    """Puts the drawing in place of the simulator, in this process."""

    def pool(make: Any, size: int, say: Any) -> InTurn:
        del say
        return InTurn([make() for _ in range(size)])

    for module, name, fast in [
        (runs, "make_config", make_config),
        (assembly, "make_environment", lambda *_, **__: runs.Drawing()),
        (assembly, "Pool", pool),
        (agents, "make_agent", lambda config, *_: runs.make_agent(config.method)),
        (learning_curve, "plot", lambda *_, **__: None),
        (parts, "ExpertDistance", lambda *_: _NoDistance()),
    ]:
        mock.patch.object(module, name, fast).start()  # fails if there is no such name


class _NoDistance:
    def relative_distance(self, episodes: Any) -> None:
        del episodes


def train_for_ever(method: str, folder: pathlib.Path) -> None:
    """Trains one run after the other, of seeds 0, 1, ..., until it is killed."""
    seed = 0
    while True:
        runs.finished(runs.make_run(folder / f"seed{seed}", method, seed=seed))
        seed += 1


class Unbroken:
    """The runs of all seeds as they are if nothing happens to them."""

    def __init__(self, method: str, folder: pathlib.Path) -> None:
        self._method, self._folder = method, folder
        self._runs: dict[int, Any] = {}

    def difference(self, seed: int, folder: pathlib.Path) -> str:
        """Resumes the run in a folder to its end; returns how it differs, or ""."""
        unbroken = self._folder / "unbroken" / f"seed{seed}"
        try:
            if seed not in self._runs:
                unbroken.parent.mkdir(parents=True, exist_ok=True)
                run = runs.make_run(unbroken, self._method, seed=seed)
                self._runs[seed] = runs.finished(run)
            resumed = runs.finished(runs.make_run(folder, self._method, seed=seed))
            names = (str(folder), str(unbroken))
            runs.assert_same(resumed, self._runs[seed], self._folder, *names)
        except Exception as error:
            return f"{folder.name}: {type(error).__name__}: {error}"
        return ""


def killed(
    method: str, count: int, rng: np.random.Generator, folder: pathlib.Path
) -> Iterator[str]:
    """Freezes a training process and copies the files that a kill would leave.

    The last one is killed.
    """
    live = folder / "live"
    live.mkdir()
    command = [sys.executable, "-m", "tests.faults.runs", "for_ever", method]
    copies: list[tuple[int, pathlib.Path]] = []
    with subprocess.Popen([*command, "0", "0", str(live)]) as process:
        while len(copies) < count:
            assert process.poll() is None, "the run has ended"
            time.sleep(rng.uniform(0.02, 0.2))
            seeds = [int(path.name[4:]) for path in live.glob("seed*")]
            if not seeds or not list(live.glob("seed0/checkpoints/frame_*")):
                continue
            is_last = len(copies) == count - 1
            process.send_signal(signal.SIGKILL if is_last else signal.SIGSTOP)
            _wait_until_still(process.pid)
            copy = folder / f"copy{len(copies)}"
            shutil.copytree(live / f"seed{max(seeds)}", copy)
            copies.append((max(seeds), copy))
            process.send_signal(signal.SIGCONT)
    unbroken = Unbroken(method, folder)
    for seed, copy in copies:
        yield unbroken.difference(seed, copy)


def _wait_until_still(process: int) -> None:
    stat = pathlib.Path(f"/proc/{process}/stat")
    while stat.read_text().rpartition(")")[2].split()[0] not in "TZX":
        time.sleep(0.001)


def stopped(
    method: str, count: int, rng: np.random.Generator, folder: pathlib.Path
) -> Iterator[str]:
    """Sends itself SIGTERM at any moment, again and again, until each run has ended."""
    unbroken = Unbroken(method, folder)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # one that comes too late
    seed = stops = 0
    while count > 0:
        place = folder / f"stopped{seed}"
        run = runs.make_run(place, method, seed=seed)
        seconds = rng.uniform(0.0, 1.0)
        timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM))
        timer.start()
        with StopOnSignals(run.ask_to_stop):
            runs.finished(run)
        timer.cancel()
        stops += run.stop_asked
        if not run.stop_asked or stops >= count:
            difference = unbroken.difference(seed, place)
            yield from [difference] * min(stops, count)
            count, stops, seed = count - stops, 0, seed + 1


def out_of_disk(
    method: str, count: int, rng: np.random.Generator, folder: pathlib.Path
) -> Iterator[str]:
    """Trains on a small disk that is enlarged once it is full; needs root."""
    unbroken = Unbroken(method, folder)
    unbroken.difference(0, folder / "whole")
    files = (folder / "whole").rglob("*")
    whole_bytes = sum(path.stat().st_size for path in files if path.is_file())
    for number in range(count):
        disk = folder / f"disk{number}"
        disk.mkdir()
        size = int(rng.uniform(0.02, 0.7) * whole_bytes)
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
        subprocess.run(mount, check=True)
        try:
            said = ""
            try:
                runs.finished(runs.make_run(disk / "run", method, seed=0))
            except RunFolderError as error:
                said = str(error)
            except Exception as error:
                yield f"{size} bytes: {type(error).__name__}: {error}"
                continue
            mount = ["mount", "-o", "remount,size=256m", str(disk)]
            subprocess.run(mount, check=True)
            if "No space left" not in said or "newest checkpoint" not in said:
                yield f"{size} bytes: it said {said!r}"
            else:
                yield unbroken.difference(0, disk / "run")
        finally:
            subprocess.run(["umount", "--lazy", str(disk)], check=True)


def main() -> None:
    """Runs one kind of fault."""
    kind, method, count, seed, folder = sys.argv[1:]
    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is rendered
    startup.prepare()
    replace_what_is_slow()
    place = pathlib.Path(folder)
    if kind == "for_ever":
        with contextlib.redirect_stdout(sys.stderr):
            train_for_ever(method, place)
    work = {"killed": killed, "stopped": stopped, "out_of_disk": out_of_disk}[kind]
    results = work(method, int(count), np.random.default_rng(int(seed)), place)
    while True:
        with contextlib.redirect_stdout(sys.stderr):  # what the runs say
            result = next(results, None)
        if result is None:
            return
        print(" ".join(result.split())[:500], flush=True)


if __name__ == "__main__":
    main()
