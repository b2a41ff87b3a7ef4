"""Stands in for `jaxil.launch` where only its files and signals matter; starts fast.

It keeps a run's folder as the real one does: lock, tables, checkpoints, resuming from
the newest checkpoint, and saving at the first request to stop.
"""

import argparse
import os
import pathlib
import signal
import sys
import time

from jaxil.config import default_config
from jaxil.errors import UsageError
from jaxil.files.tables import CsvLog
from jaxil.machine.signals import StopOnSignals
from jaxil.sweeps.state import Run
from jaxil.training import workdir

FRAMES = 1000  # of an episode
_EVERY = 5  # episodes from checkpoint to checkpoint


def stand_in(
    folder: pathlib.Path, name: str, *, episodes: int, seconds: float, extra: str = ""
) -> Run:
    """Returns a run of the stand-in.

    Args:
      folder: of the sweep.
      name: plays the part of the task.
      episodes: until it is finished.
      seconds: that an episode takes.
      extra: a further flag of `main`.
    """
    home = folder / name / "zero" / "seed0"
    command = [sys.executable, "-m", "tests.trainer", str(home), str(episodes)]
    command += [str(seconds), *([extra] if extra else [])]
    return Run(name, "zero", "zero", 0, home, FRAMES * episodes, tuple(command))


def main() -> int:
    """Trains nothing, episode by episode."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("episodes", type=int)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--fail", action="store_true", help="ends with status 3")
    parser.add_argument("--slow", action="store_true", help="takes 5 s to save")
    parser.add_argument("--place", action="store_true", help="prints cores and limits")
    flags = parser.parse_args()
    try:
        with workdir.opened(flags.folder):
            return _train(flags)
    except UsageError as error:
        print(error)
        return 2


def _train(flags: argparse.Namespace) -> int:
    if flags.place:
        cores = sorted(os.sched_getaffinity(0))
        limits = os.environ["OMP_NUM_THREADS"], os.environ.get("CUDA_VISIBLE_DEVICES")
        print("place", cores, *limits, flush=True)
    if flags.fail:
        print("the reason of the failure", flush=True)
        return 3
    workdir.write_config(flags.folder, default_config("zero", "walker_walk"), {})
    checkpoints = flags.folder / "checkpoints"
    saved = [int(path.name[6:]) // FRAMES for path in checkpoints.glob("frame_*")]
    begin = max(saved, default=0)
    resume_frame = begin * FRAMES if saved else None
    print(f"from episode {begin}", flush=True)
    columns = ("frame", "seconds", "process")
    table = CsvLog(flags.folder / "train.csv", columns, resume_frame=resume_frame)
    asked = []

    def ask(who: str) -> bool:
        asked.append(who)
        print(f"{who}: request {len(asked)}", flush=True)
        return len(asked) == 1

    with StopOnSignals(ask):
        for episode in range(begin + 1, flags.episodes + 1):
            time.sleep(flags.seconds)
            frame = episode * FRAMES
            table.append({"frame": frame, "seconds": episode, "process": os.getpid()})
            if asked and flags.slow:
                time.sleep(5.0)
            if episode % _EVERY == 0 or episode == flags.episodes or asked:
                (checkpoints / f"frame_{frame:012d}").mkdir(parents=True)
            if asked:
                return 130
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
