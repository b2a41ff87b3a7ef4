"""From a wheel to a report, as somebody does who has never seen the repository.

The new environment holds the wheel alone; what jaxil depends on comes from this one,
since its installation takes minutes.
"""

import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import venv

import pytest

from jaxil.files.tables import read_csv
from jaxil.machine.cache import cache_folder
from tests.commands import ROOT, small
from tests.processes import wait_for

_RECORD = """
import av
import gymnasium
import numpy as np

settings = {"render_mode": "rgb_array", "width": 64, "height": 48}
environment = gymnasium.make("InvertedPendulum-v5", **settings)
state, _ = environment.reset(seed=0)
with av.open("my_video.mp4", "w") as file:
    stream = file.add_stream("libx264", 25)
    stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
    for _ in range(30):
        image = np.ascontiguousarray(environment.render())
        file.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        state, *_ = environment.step([1.5 * state[1] + 0.9 * state[3]])
    file.mux(stream.encode())
"""
_POLICY, _METHOD = (
    re.search(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    for page in ("README.md", "docs/own.md")
)
_TASK = "gymnasium:InvertedPendulum-v5"
_PENDULUM = (
    "--config.demonstrations.num_episodes=1",
    "--config.action_repeat=2",
    "--config.seed_frames=40",
    "--config.exploration_steps=10",
    "--config.eval_every_frames=60",
    "--config.checkpoint_every_frames=60",
    "--config.total_frames=60",
)


@pytest.fixture(name="home")
def _home(tmp_path, monkeypatch) -> pathlib.Path:
    """A user's home, where `jaxil` is the wheel's and the checkout is out of sight."""
    monkeypatch.delenv("PYTHONPATH", raising=False)
    source, environment, home = (tmp_path / name for name in ("source", "env", "home"))
    for folder in (source, home):
        folder.mkdir()
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(
        ROOT / "jaxil", source / "jaxil", ignore=shutil.ignore_patterns("*.pyc")
    )
    build = "from setuptools.build_meta import build_wheel; build_wheel('.')"
    subprocess.run([sys.executable, "-c", build], check=True, cwd=source, timeout=300)
    venv.create(environment, with_pip=False)
    python = str(environment / "bin" / "python")
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "-q")
    wheels = map(str, source.glob("*.whl"))
    words = (*pip, "--no-deps", "--no-index", *wheels)
    subprocess.run(words, check=True, cwd=home, timeout=300)
    (packages,) = environment.glob("lib/python*/site-packages")
    # A folder on the path: .pth files in it, such as the checkout's, have no effect.
    (packages / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    shutil.rmtree(source)
    assert _files(packages) == _files(ROOT)
    monkeypatch.setenv("PATH", str(environment / "bin"), prepend=os.pathsep)
    # Programs that jax, GL and Matplotlib have prepared before stay in reach.
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache_folder().parent))
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.chdir(home)
    where = run("python", "-c", "import jaxil; print(jaxil.__file__)")
    assert pathlib.Path(where.strip()).is_relative_to(packages)
    return home


def run(*words: str) -> str:
    """Runs a command of the new environment; returns its output and what it said."""
    finished = subprocess.run(
        words,
        check=False,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )
    assert finished.returncode == 0, finished.stdout
    return finished.stdout


def test_a_wheel_is_enough(home, monkeypatch):
    train = (
        "jaxil",
        "train",
        "--config=tiny:pdac,cartpole_swingup",
        "--workdir=~/runs/x",
        *small("pdac"),
        "--config.action_repeat=20",
        "--config.total_frames=2000",
    )
    folder = home / "runs" / "x"
    process = subprocess.Popen(train, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: _rows(folder) or process.poll() is not None, 600)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 130, said
    assert "rerun the same command to resume" in said
    assert "Traceback" not in said
    assert "resuming from the checkpoint of frame" in run(*train)
    assert read_csv(folder / "train.csv")["frame"].tolist() == [1000, 2000]

    assert "the expert's mean" in run(
        "jaxil",
        "evaluate",
        "--workdir=~/runs/x",
        "--num_episodes=1",
        "--video_size=64",
        "--gif",
    )
    for suffix in ("mp4", "gif"):
        (film,) = (folder / "videos").glob(f"evaluation_*.{suffix}")
        assert film.stat().st_size > 1_000

    # README's lines on the policy, and a video of one's own.
    assert _POLICY is not None
    (home / "runs" / "quickstart").symlink_to(folder)
    (home / "script.py").write_text(f"{_POLICY[1]}\nprint(timestep.last()){_RECORD}")
    assert "True" in run("python", "script.py")
    (home / "runs" / "quickstart").unlink()

    assert _METHOD is not None
    (home / "my_method.py").write_text(_METHOD[1])
    monkeypatch.setenv("PYTHONPATH", str(home))
    run(
        "jaxil",
        "train",
        f"--config=tiny:my_method:METHOD,{_TASK}",
        "--config.demonstrations.source=my_video.mp4",
        "--workdir=~/runs/y",
        *small("zero"),
        *_PENDULUM,
    )
    own = read_csv(home / "runs" / "y" / "train.csv")
    assert set(own["brightness/weight"]) == {1.0}
    assert (own["imitation_return"] < 0).all()
    assert list((home / "runs" / "y" / "videos").glob("frame_*.mp4"))

    run("jaxil", "report", "runs", "--output=report", "--trust=my_method:METHOD")
    page = (home / "report" / "index.html").read_text()
    own = "Brightness", "brightness/weight", _TASK
    for words in ("P-DAC", "cartpole_swingup", *own):
        assert words in page


def _files(root: pathlib.Path) -> set[pathlib.Path]:
    found = {path for path in (root / "jaxil").rglob("*") if path.is_file()}
    return {path.relative_to(root) for path in found if path.suffix != ".pyc"}


def _rows(folder: pathlib.Path) -> int:
    table = folder / "train.csv"
    return table.read_text().count("\n") - 1 if table.exists() else 0
