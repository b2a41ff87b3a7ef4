"""Strictness for all tests: no silent broadcasting, and one way of rendering."""

import gc
import os
import signal

# Before jax and MuJoCo are imported anywhere: flags and GL are read only once.
from jaxil.machine import startup

# One core for each of xdist's processes and the programs that their tests start: with
# two threads each, three processes on two cores get in each other's way.
_worker = os.environ.get("PYTEST_XDIST_WORKER", "")
if _worker and hasattr(os, "sched_setaffinity"):
    _cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {_cores[int(_worker.removeprefix("gw")) % len(_cores)]})
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Tracing takes most of the time, and a fifth of it goes into recording where in the
# source each operation is and into garbage collections that find nothing.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
gc.set_threshold(50_000, 20, 20)
startup.prepare()

# A shell that starts the tests in the background has them ignore Ctrl-C, nohup has them
# ignore hang-ups, and so would all programs whose signals are tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

import jax  # noqa: E402

# Files with the longest tests, those first that mostly wait for other processes.
_LONGEST = (
    "test_slurm.py",
    "test_sweep.py",
    "test_adoption.py",
    "test_end_to_end.py",
    "test_methods.py",
    "test_own_tasks.py",
    "test_benchmark.py",
    "test_report.py",
    "test_library.py",
)


def pytest_collection_modifyitems(items):
    """Puts the longest tests first, so that no process is left alone with them."""
    places = {name: place for place, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: places.get(item.path.name, len(places)))


# [B] against [B, 1] is the classic silent error of reinforcement learning.
jax.config.update("jax_numpy_rank_promotion", "raise")
