"""Drawing by several processes: the same images and files, whatever becomes of them.

A process takes a second or two to start, on a crowded machine much longer; so the tests
have this one wait until the other one can draw.
"""

import logging
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxil.demonstrations import drawer, drawing, rendering
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.environments.suite import make_environment
from tests.commands import ROOT

TASK = "finger_turn_hard"  # its target is not part of the simulator's state
SEED, FIRST, EPISODES, LENGTH, SIZE = 5, 3, 3, 40, 24
TOTAL = EPISODES * LENGTH
WAIT_SECONDS = 300  # for a machine that is crowded


def make_states():
    environment = make_environment(TASK, seed=SEED, observation="state")
    rng = np.random.default_rng(0)
    widths = {name: len(value) for name, value in environment.simulator_state().items()}
    environment.close()
    return {
        name: rng.normal(size=(EPISODES, LENGTH, width))
        for name, width in widths.items()
    }


STATES = make_states()


def observe(progress=None, processes: int | None = 1, cache=True, quality="fast"):
    return rendering.observe_episodes(
        STATES,
        task=TASK,
        seed=SEED,
        first_episode=FIRST,
        image_size=SIZE,
        render_quality=quality,
        cache=cache,
        progress=progress,
        processes=processes,
    )


@pytest.fixture(name="alone", scope="module")
def _alone(tmp_path_factory):
    """Images and cache files of one process."""
    folder = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXIL_CACHE", str(folder))
        return observe(), files_in(folder)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXIL_CACHE", str(tmp_path / "cache"))


@pytest.fixture(name="drawers")
def _drawers(monkeypatch):
    """The other processes, as they are started."""
    started = []

    class Watched(drawer.Drawer):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self.num_images = 0
            started.append(self)

        def receive(self, take):
            def counted(place, start, images):
                self.num_images += len(images)
                take(place, start, images)

            super().receive(counted)

    monkeypatch.setattr(drawing, "Drawer", Watched)
    return started


def files_in(folder):
    return {path.name: path.read_bytes() for path in (folder / "frames").iterdir()}


def pid_of(one):
    return one._process.pid


def is_gone(pid):
    """Whether the process is no more; a zombie is still there."""
    return not pathlib.Path(f"/proc/{pid}").exists()


class Progress:
    """Writes down the calls, and has this process wait for the other one.

    After the first image for its start, after the second one for images of its own;
    once the first of those are there, it does something.
    """

    def __init__(self, drawers, do=lambda: None):
        self.calls = []
        self._drawers, self._do = drawers, do
        self._has_done = False

    def __call__(self, drawn, total):
        self.calls.append((drawn, total))
        (other,) = self._drawers
        if drawn <= 2 and not other.pipe.closed:
            assert other.pipe.poll(WAIT_SECONDS)
        if other.num_images and not self._has_done:
            self._has_done = True
            self._do()


def assert_whole(progress):
    assert progress.calls == [(number + 1, TOTAL) for number in range(TOTAL)]


def test_two_processes_draw_what_one_draws(drawers, tmp_path, caplog, monkeypatch):
    images = observe(quality="paper")
    files = files_in(tmp_path / "cache")
    monkeypatch.setenv("JAXIL_CACHE", str(tmp_path / "again"))
    libraries = []

    def look():
        maps = pathlib.Path(f"/proc/{pid_of(drawers[0])}/maps").read_text()
        libraries.extend(name for name in ("mujoco", "jaxlib") if name in maps)

    progress = Progress(drawers, look)
    found = observe(progress, processes=2, quality="paper")
    np.testing.assert_array_equal(found, images)
    assert len(np.unique(images.reshape(TOTAL, -1), axis=0)) == TOTAL
    assert files_in(tmp_path / "again") == files
    assert len(files) == EPISODES
    assert_whole(progress)
    (other,) = drawers
    assert 0 < other.num_images < TOTAL, "both have drawn"
    assert is_gone(pid_of(other))
    assert libraries == ["mujoco"], "jax takes seconds and memory"
    assert not caplog.records


@pytest.mark.parametrize(
    ("number", "said"),
    [(signal.SIGKILL, "was killed by SIGKILL"), (signal.SIGSTOP, "does not answer")],
)
def test_a_lost_process_is_done_without(
    number, said, alone, drawers, tmp_path, caplog, monkeypatch
):
    def lose():
        os.kill(pid_of(drawers[0]), number)
        if number == signal.SIGSTOP:  # on a busy machine a second is nothing
            monkeypatch.setattr(drawer, "_SILENCE_SECONDS", 1.0)

    progress = Progress(drawers, lose)
    images, files = alone
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(observe(progress, processes=2), images)
    assert files_in(tmp_path / "cache") == files
    assert_whole(progress)
    (record,) = caplog.records
    assert said in record.getMessage()
    (other,) = drawers
    assert 0 < other.num_images < LENGTH, "lost within its first episode"
    assert is_gone(pid_of(other))


@pytest.mark.parametrize("fault", ["another renderer", "an error", "no process"])
def test_a_process_that_cannot_draw_is_done_without(
    fault, alone, drawers, caplog, monkeypatch
):
    start = drawing.Drawer

    def worse(settings, gl_name, waiting):
        if fault == "no process":
            raise BlockingIOError("no more processes")
        if fault == "an error":
            return start({**settings, "task": "walker_wlak"}, gl_name, waiting)
        return start(settings, "a GPU", waiting)

    monkeypatch.setattr(drawing, "Drawer", worse)
    progress = None if fault == "no process" else Progress(drawers)
    np.testing.assert_array_equal(observe(progress, processes=2), alone[0])
    said = {
        "another renderer": "where a GPU is wanted",
        "an error": "'walker_wlak' is not a task",
        "no process": "could not be started (no more processes)",
    }
    assert said[fault] in caplog.text
    assert all(other.num_images == 0 for other in drawers)


_SCRIPT = """
import sys
from tests.demonstrations import test_drawing
from jaxil.demonstrations import drawing

started = []

class Watched(drawing.Drawer):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        started.append(self)

drawing.Drawer = Watched

def progress(drawn, total):
    if drawn == 1:
        assert started[0].pipe.poll(test_drawing.WAIT_SECONDS)
        print(test_drawing.pid_of(started[0]), flush=True)
        sys.stdin.readline()

try:  # not guarded by __name__: a process of multiprocessing would come here again
    test_drawing.observe(progress, processes=2)
except KeyboardInterrupt:
    print("stopped", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_parent_that_is_stopped_leaves_nothing(number, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(_SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, str(script)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    assert not is_gone(pid)
    assert os.getpgid(pid) != os.getpgid(parent.pid), "Ctrl-C is not for it"
    os.killpg(parent.pid, number)  # as a terminal does it
    rest, errors = parent.communicate(timeout=60)
    end = time.monotonic() + 30
    while not is_gone(pid) and number == signal.SIGKILL:
        # What a killed parent leaves is buried by others, in their own time.
        status = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")")[-1]
        if status.split()[0] == "Z":
            break
        assert time.monotonic() < end
        time.sleep(0.05)
    if number == signal.SIGINT:
        assert is_gone(pid)
        assert rest == "stopped\n"
    assert errors == ""
    assert not list((tmp_path / "cache").rglob("*.part"))


def test_an_interrupt_keeps_the_episodes_that_are_whole(alone, drawers, tmp_path):
    progress = Progress(drawers)

    def interrupt(drawn, total):
        progress(drawn, total)
        if drawn == 2 * LENGTH:  # two begin no third episode before one is whole
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        observe(interrupt, processes=2)
    found = files_in(tmp_path / "cache")
    assert found.items() <= alone[1].items()
    assert 0 < len(found) < EPISODES
    assert is_gone(pid_of(drawers[0]))


@pytest.mark.parametrize(
    ("cores", "gl_name", "seconds", "expected"),
    [
        (2, "llvmpipe (LLVM 15.0.6, 256 bits)", 100.0, 2),
        (64, "llvmpipe (LLVM 15.0.6, 256 bits)", 100.0, 8),
        (64, "softpipe", 100.0, 8),
        (1, "softpipe", 100.0, 1),
        (2, "softpipe", 1.0, 1),
        (64, "NVIDIA H100 80GB HBM3/PCIe/SSE2", 100.0, 1),
    ],
)
def test_how_many_processes_pay(cores, gl_name, seconds, expected, monkeypatch):
    monkeypatch.setattr(drawing.os, "sched_getaffinity", lambda _: set(range(cores)))
    assert drawing.how_many(10, seconds=seconds, gl_name=gl_name) == expected
    fewer = min(expected, 3)
    assert drawing.how_many(3, seconds=seconds, gl_name=gl_name) == fewer


@pytest.mark.parametrize("pays", [True, False])
def test_processes_are_started_where_they_pay(pays, alone, drawers, monkeypatch):
    asked = []
    draw = PixelEnvironment.single_observation

    def slowly(self):
        time.sleep(0.01)
        return draw(self)

    def how_many(num_episodes, *, seconds, gl_name):
        asked.append((num_episodes, gl_name))
        assert 0.01 * (TOTAL - 5) <= seconds < np.inf, "five are there"
        return 2 if pays else 1

    monkeypatch.setattr(PixelEnvironment, "single_observation", slowly)
    monkeypatch.setattr(drawing, "how_many", how_many)
    images = observe(processes=None, cache=False)
    np.testing.assert_array_equal(images, alone[0])
    ((num_episodes, gl_name),) = asked
    assert num_episodes == EPISODES
    assert gl_name
    assert len(drawers) == pays
