"""Rendering by several processes: the same images and files, whatever happens."""

import contextlib
import logging
import multiprocessing
import multiprocessing.connection
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from jaxil.demonstrations import loading, rendering, states
from jaxil.environments.suite import SuiteEnvironment
from jaxil.environments.tasks import make_environment
from tests.commands import ROOT
from tests.processes import wait_until_gone

TASK = "finger_turn_hard"  # its target is not part of the simulator's state
SEED, FIRST, EPISODES, LENGTH, SIZE = 5, 3, 3, 20, 24
TOTAL = EPISODES * LENGTH
REAL_RENDER = rendering._render_episode


def make_states():
    environment = make_environment(TASK, seed=SEED, observation="state")
    assert isinstance(environment, SuiteEnvironment)
    rng = np.random.default_rng(0)
    widths = {name: len(value) for name, value in environment.simulator_state().items()}
    environment.close()
    return {
        name: rng.normal(size=(EPISODES, LENGTH, width))
        for name, width in widths.items()
    }


STATES = make_states()


def observe(progress=None, processes: int | None = 1, states=STATES):
    return rendering.observe_episodes(
        states,
        task=TASK,
        seed=SEED,
        first_episode=FIRST,
        image_size=SIZE,
        render_quality="fast",
        progress=progress,
        processes=processes,
    )


@pytest.fixture(name="alone", scope="module")
def _alone(tmp_path_factory):
    """Images and cached files of one process."""
    folder = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXIL_CACHE", str(folder))
        images = observe()
    assert len(np.unique(images.reshape(TOTAL, -1), axis=0)) == TOTAL
    return images, pixels_in(folder)


def pixels_in(folder):
    found = {}
    for path in (folder / "frames").iterdir():
        with np.load(path) as stored:
            found[path.name] = stored["images"].tobytes()
    return found


def children() -> list[int]:
    """Returns the processes of multiprocessing that this one has started."""
    return [each.pid for each in multiprocessing.active_children() if each.pid]


def test_two_processes_render_what_one_renders(alone, tmp_path, caplog):
    calls, libraries = [], set()

    def progress(done, total):
        calls.append((done, total))
        for pid in children():
            maps = pathlib.Path(f"/proc/{pid}/maps").read_text()
            libraries.update(name for name in ("mujoco", "jaxlib") if name in maps)

    np.testing.assert_array_equal(observe(progress, processes=2), alone[0])
    assert pixels_in(tmp_path / "cache") == alone[1]
    assert len(alone[1]) == EPISODES
    assert calls == [(LENGTH * (number + 1), TOTAL) for number in range(EPISODES)]
    assert libraries == {"mujoco"}, "jax takes seconds and memory"
    assert not children()
    assert not caplog.records


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_lost_processes_are_done_without(number, alone, tmp_path, caplog, monkeypatch):
    calls = []
    if number == signal.SIGSTOP:
        monkeypatch.setattr(rendering, "_TIMEOUT_SECONDS", 3.0)

    def lose():
        while len(pids := children()) < 2:
            time.sleep(0.01)
        for pid in pids:
            os.kill(pid, number)

    thread = threading.Thread(target=lose)
    thread.start()
    with caplog.at_level(logging.WARNING):
        images = observe(lambda *call: calls.append(call), processes=2)
    thread.join()
    np.testing.assert_array_equal(images, alone[0])
    assert pixels_in(tmp_path / "cache") == alone[1]
    assert calls == [(done + 1, TOTAL) for done in range(TOTAL)]
    (record,) = caplog.records
    said = "terminated" if number == signal.SIGKILL else "no episode in 3 s"
    assert said in record.getMessage()
    assert not children()


@pytest.mark.parametrize("fault", ["another renderer", "no process"])
def test_processes_that_cannot_render_are_done_without(
    fault, alone, caplog, monkeypatch
):
    if fault == "no process":

        def submit(*_):
            raise BlockingIOError("no more processes")

        executor = rendering.concurrent.futures.ProcessPoolExecutor
        monkeypatch.setattr(executor, "submit", submit)
    else:
        real = rendering._render_together
        monkeypatch.setattr(
            rendering,
            "_render_together",
            lambda processes, episodes, settings, _: real(
                processes, episodes, settings, "a GPU"
            ),
        )
    np.testing.assert_array_equal(observe(processes=2), alone[0])
    said = {"another renderer": "not with a GPU", "no process": "no more processes"}
    assert said[fault] in caplog.text
    assert not children()


def test_states_of_another_model_are_refused():
    states = {**STATES, "qpos": STATES["qpos"][..., :-1]}
    for processes in (1, None):
        with pytest.raises(ValueError, match="qpos has shape"):
            observe(processes=processes, states=states)


def test_a_task_without_simulator_states_is_refused(monkeypatch):
    def make_environment(**_):
        return contextlib.nullcontext()

    monkeypatch.setattr(rendering.tasks, "make_environment", make_environment)
    with pytest.raises(ValueError, match=f"states, which {TASK} cannot take"):
        observe()


def wait_for(path):
    while not path.exists():
        time.sleep(0.01)


def render_and_send_half(settings, gl_name, number, states):
    """Renders in a process; all but the first episode are never sent whole."""
    send = multiprocessing.connection.Connection._send  # pyright: ignore

    def send_half(connection, buffer):
        send(connection, buffer[: len(buffer) // 2])
        (folder / "half_sent").touch()
        time.sleep(1000)

    folder = pathlib.Path(os.environ["MARKS"])
    if number > FIRST:
        wait_for(folder / "first_received")  # which half an image would hold up
        multiprocessing.connection.Connection._send = send_half  # pyright: ignore
    return REAL_RENDER(settings, gl_name, number, states)


def test_half_sent_images_are_not_waited_for(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "_render_episode", render_and_send_half)
    monkeypatch.setenv("MARKS", str(tmp_path))
    stopped = []

    def stop(*_):
        (tmp_path / "first_received").touch()
        wait_for(tmp_path / "half_sent")
        raise KeyboardInterrupt

    def observe_until_stopped():
        try:
            observe(stop, processes=2)
        except KeyboardInterrupt:
            stopped.append(True)

    thread = threading.Thread(target=observe_until_stopped, daemon=True)
    thread.start()
    thread.join(60)
    assert stopped
    assert not children()


_SCRIPT = """
import sys
from tests.demonstrations import test_rendering

def progress(done, total):
    print(*test_rendering.children(), flush=True)
    sys.stdin.readline()

try:  # not guarded by __name__: a process must not come here again
    test_rendering.observe(progress, processes=2)
except KeyboardInterrupt:
    print("stopped", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_parent_that_is_stopped_leaves_nothing(number, alone, tmp_path):
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
    pids = [int(word) for word in parent.stdout.readline().split()]
    assert len(pids) == 2
    if number == signal.SIGINT:
        os.killpg(parent.pid, number)  # as a terminal does it
    else:
        parent.kill()
    rest, errors = parent.communicate(timeout=60)
    wait_until_gone(pids)
    if number == signal.SIGINT:
        assert rest == "stopped\n"
        assert errors == ""
    assert not list((tmp_path / "cache").rglob(".tmp-*"))
    found = pixels_in(tmp_path / "cache")
    assert found.items() <= alone[1].items()
    assert found, "the first episode was whole"


@pytest.mark.parametrize(
    ("cores", "gl_name", "num_pixels", "expected"),
    [
        (2, "llvmpipe (LLVM 15.0.6, 256 bits)", 10**8, 2),
        (64, "llvmpipe (LLVM 15.0.6, 256 bits)", 10**8, 8),
        (64, "softpipe", 10**8, 8),
        (1, "softpipe", 10**8, 1),
        (2, "softpipe", 10**5, 1),
        (64, "NVIDIA H100 80GB HBM3/PCIe/SSE2", 10**8, 1),
    ],
)
def test_how_many_processes_pay(cores, gl_name, num_pixels, expected, monkeypatch):
    monkeypatch.setattr(rendering.os, "sched_getaffinity", lambda _: set(range(cores)))
    assert rendering.num_processes(num_pixels, gl_name) == expected


@pytest.mark.parametrize("pays", [True, False])
def test_processes_are_started_where_they_pay(pays, alone, monkeypatch):
    started = []

    def render_together(processes, *_):
        started.append(processes)
        yield from ()  # which leaves all to this process

    monkeypatch.setattr(rendering, "_render_together", render_together)
    monkeypatch.setattr(rendering, "renders_in_software", lambda gl_name: True)
    monkeypatch.setattr(rendering.os, "sched_getaffinity", lambda _: {0, 1})
    num_pixels = TOTAL * SIZE**2
    monkeypatch.setattr(rendering, "_MIN_PARALLEL_PIXELS", num_pixels + (not pays))
    np.testing.assert_array_equal(observe(processes=None), alone[0])
    assert started == [2] * pays


def test_the_expert_is_seen_from_the_agents_camera():
    task, seen = "cartpole_swingup", {}
    stored = states.read_states(states.shipped_path(task), num_episodes=1)
    frame = 25 * stored.metadata["action_repeat"]
    arrays = stored.simulator_states(slice(25, 26))
    state = {name: array[0, 0] for name, array in arrays.items()}
    for camera in ("", "fixed", "lookatcart"):  # in one cache
        settings = {"task": task, "camera": camera, "image_size": SIZE}
        settings["render_quality"] = "fast"
        expert = loading.load(num_episodes=1, action_repeat=frame, **settings)
        with make_environment(seed=0, **settings) as environment:
            assert isinstance(environment, SuiteEnvironment)
            environment.reset()
            environment.set_simulator_state(**state)
            seen[camera] = environment.single_observation()
        np.testing.assert_array_equal(expert.frames[0, 1], seen[camera])
    np.testing.assert_array_equal(seen[""], seen["fixed"])
    assert np.mean(seen[""] != seen["lookatcart"]) > 0.5
