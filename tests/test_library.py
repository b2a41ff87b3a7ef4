"""jaxil as a library, and what a machine without OpenGL or CUDA says."""

import os
import subprocess
import sys

import numpy as np
import pytest

import jaxil
from tests import own_loop
from tests.commands import ROOT, arguments


def _run(*words: str, **variables: str | None):
    changed = {**os.environ, "JAX_PLATFORMS": "cpu", **variables}
    return subprocess.run(
        words,
        check=False,
        cwd=ROOT,
        env={name: value for name, value in changed.items() if value is not None},
        capture_output=True,
        text=True,
        timeout=240,
    )


def _python(script: str, **variables: str | None):
    return _run(sys.executable, "-c", script, **variables)


def test_an_agent_learns_in_a_loop_of_ones_own():
    metrics = own_loop.main()
    assert {"critic/loss", "actor/loss", "discriminator/loss"} <= set(metrics)
    assert np.all(np.isfinite(list(metrics.values())))


def test_the_package_is_imported_without_jax():
    script = "import jaxil, sys; sys.exit('jax' in sys.modules)"
    assert _python(script).returncode == 0
    script = "import jaxil; jaxil.nothing"
    assert "has no attribute 'nothing'" in _python(script).stderr


_OBSERVE = """
from jaxil.environments import tasks
for observation in {!r}:
    made = tasks.make_environment("cartpole_swingup", seed=0, observation=observation)
    print(made.reset().observation.shape)
"""


def test_environments_need_no_call_before_their_import():
    made = _python(_OBSERVE.format(["pixels"]), MUJOCO_GL=None, PYOPENGL_PLATFORM=None)
    assert made.stdout == "(84, 84, 9)\n", made.stderr


def test_states_need_no_opengl():
    no_display = {"MUJOCO_GL": "glfw", "DISPLAY": None, "WAYLAND_DISPLAY": None}
    failed = _python(_OBSERVE.format(["state", "pixels"]), **no_display)
    assert failed.stdout == "(5,)\n"
    assert "MUJOCO_GL=glfw does not work here (there is no display)" in failed.stderr


@pytest.mark.parametrize(("most_frames", "steps"), [(0, 125), (20, 3)])
def test_tasks_without_a_time_limit_end(most_frames, steps):
    environment = jaxil.make_environment(
        "lqr_lqr_2_1",
        seed=0,
        observation="state",
        action_repeat=8,
        max_episode_frames=most_frames,
    )
    assert environment.episode_steps == steps
    timestep, played = environment.reset(), 0
    while not timestep.last():
        played += 1
        timestep = environment.step(np.zeros(environment.action_spec().shape))
    assert (played, timestep.discount) == (steps, 1.0)


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"MUJOCO_GL": "wrong"}, "MUJOCO_GL='wrong' is unknown; choose one of: egl"),
        ({"MUJOCO_GL": "disable"}, "rendering is not available"),
        ({"JAX_PLATFORMS": "cuda"}, "JAX_PLATFORMS='cuda' is not available here"),
    ],
)
def test_what_the_machine_lacks_is_one_message(variables, expected, tmp_path):
    folder = tmp_path / "run"
    flags = ("--config=zero:cartpole_swingup", f"--workdir={folder}")
    finished = _run(*arguments("launch", *flags), **variables)
    assert finished.returncode == 2
    assert expected in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not folder.exists()
