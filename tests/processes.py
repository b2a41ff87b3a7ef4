"""Other processes: starting them and waiting for their end."""

import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterable

ROOT = pathlib.Path(__file__).parent.parent


def run_python(source: str, *arguments: str, **variables: str) -> str:
    """Runs a program in a separate process, without warnings; returns its output."""
    finished = subprocess.run(
        [sys.executable, "-W", "error", "-c", source, *arguments],
        cwd=ROOT,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
        timeout=600.0,
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def wait_for(condition: Callable[[], object], seconds: float = 100.0) -> None:
    """Waits until a condition is true; fails after some time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "too slow"
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    """Returns whether a process exists and is no zombie."""
    try:
        status = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")")[-1]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return status.split()[0] != "Z"


def wait_until_gone(pids: Iterable[int]) -> None:
    """Waits for the end of processes, none of which may be left behind."""
    wait_for(lambda: not any(map(is_alive, pids)), 30.0)
