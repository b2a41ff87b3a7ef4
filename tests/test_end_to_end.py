"""Whole runs on a real task, as a user types them."""

import json
import os
import subprocess
import sys
import types

import jax
import numpy as np
import pytest
from flax.traverse_util import unflatten_dict

import jaxil
from jaxil import export
from jaxil.files.tables import read_csv
from jaxil.training import expert_distance, learner_files, learning_curve, parts
from tests.commands import ROOT, arguments, call, small_run
from tests.demonstrations.videos import open_video
from tests.processes import wait_for

_CLOCKS = ("seconds", "frames_per_second", "reward_seconds")
# Three episodes; rewards are refreshed at frames 2000 and 3000. The components that the
# discriminator judges are those of the first episode, also after a resumption.
_REFRESHED = (
    "--config.reward_refresh_steps=100",
    "--config.total_frames=3000",
    "--config.discriminator.num_components=4",
    "--config.policy_tau=0.1",
    "--config.learning_rate_steps=100",
)


@pytest.fixture(scope="module", autouse=True)
def _quick_distance():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(expert_distance, "_RANDOM_EPISODES", 1)
        yield


@pytest.fixture
def plain(monkeypatch):
    """Leaves out what takes long and the unbroken run shows: distances and plots."""
    distance = types.SimpleNamespace(relative_distance=lambda *_, **__: None)
    monkeypatch.setattr(parts, "ExpertDistance", lambda *_: distance)
    monkeypatch.setattr(learning_curve, "plot", lambda *_, **__: None)


@pytest.fixture(name="unbroken", scope="module")
def _unbroken(tmp_path_factory):
    """The folder of a whole P-DAC run."""
    workdir = tmp_path_factory.mktemp("unbroken")
    finished = call("launch", *small_run("pdac", workdir), *_REFRESHED)
    assert finished.returncode == 0, finished.stderr
    return workdir


def test_pdac_trains_shows_itself_and_is_exported(unbroken):
    train = read_csv(unbroken / "train.csv")
    np.testing.assert_array_equal(train["frame"], [1000, 2000, 3000])
    assert np.all(train["length"] == 100)
    assert np.all(np.isfinite(train["imitation_return"]))
    assert np.all(np.isfinite(train["discriminator/expert_logit"][1:]))
    evals = read_csv(unbroken / "eval.csv")
    np.testing.assert_array_equal(evals["frame"], [2000, 3000])
    assert np.all(evals["expert_task_return_mean"] > 800)
    assert np.all(evals["wasserstein_to_expert"] > 0)
    filmed = _filmed(unbroken)
    assert filmed["imitation_rewards"].shape == filmed["task_rewards"].shape == (100,)
    assert "plan" not in filmed
    settings = json.loads((unbroken / "config.json").read_text())
    assert settings["config"]["method"] == "pdac"
    assert settings["versions"]["jax"]
    assert settings["renderer"]
    assert (unbroken / "learning_curve.png").stat().st_size > 5_000
    films = sorted((unbroken / "videos").glob("frame_*.mp4"))
    assert [film.stem for film in films] == ["frame_000002000", "frame_000003000"]
    with open_video(films[0]) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (2 * 256 + 8, 256 + 22)
    assert list((unbroken / "tensorboard").iterdir())

    policy = jaxil.load_policy(unbroken)
    rng = np.random.default_rng(0)
    seen = rng.integers(0, 256, (3, *policy.observation_shape), np.uint8)
    export.main(["export", f"--workdir={unbroken}", f"--output={unbroken / 'policy'}"])
    actions = _exported(unbroken / "policy", seen)
    assert actions.shape == (3, 2)
    np.testing.assert_allclose(actions, policy(seen), atol=1e-5)
    np.testing.assert_allclose(policy(seen[1]), actions[1], atol=1e-5)
    assert np.ptp(actions, axis=0).min() > 1e-4  # it looks at what it is shown
    with policy.make_environment(seed=3) as environment:
        assert environment.reset().observation.shape == policy.observation_shape
    with pytest.raises(ValueError, match="expected uint8"):
        policy(seen / 255.0)

    # The same command again finds nothing left to do.
    before = (unbroken / "train.csv").read_text()
    assert call("launch", *small_run("pdac", unbroken), *_REFRESHED).returncode == 0
    assert (unbroken / "train.csv").read_text() == before


def test_the_average_policy_is_kept(unbroken):
    policy = jaxil.load_policy(unbroken)
    _, arrays = learner_files.read(unbroken / "checkpoints" / "frame_000000003000")
    tree = unflatten_dict(arrays, sep=".")
    for name in ("encoder", "actor"):
        kept = getattr(policy.params, name)
        jax.tree.map(np.testing.assert_array_equal, kept, tree["average"][name])
        newest = jax.tree.leaves(tree[name]["params"])
        assert not all(map(np.array_equal, jax.tree.leaves(kept), newest))


@pytest.mark.usefixtures("plain")
def test_outlives_its_pipe_and_resumes_bit_for_bit_after_a_kill(unbroken, tmp_path):
    process = _start(*small_run("pdac", tmp_path), *_REFRESHED)
    # It outlives the pipe that it writes to, as in `... 2>&1 | head -1`.
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.close()
    # Killed with an episode begun after the first checkpoint.
    saved = "checkpoints/frame_000000002000*"
    wait_for(lambda: list(tmp_path.glob(saved)) or process.poll() is not None, 900.0)
    process.kill()
    assert process.wait() < 0, "the run ended too soon"
    assert not (tmp_path / "checkpoints" / "frame_000000003000").exists()

    resumed = call("launch", *small_run("pdac", tmp_path), *_REFRESHED)
    assert resumed.returncode == 0, resumed.stderr
    assert "resuming from the checkpoint of frame 2000" in resumed.stderr
    assert "finished at frame" in resumed.stderr
    expected, got = (read_csv(each / "train.csv") for each in (unbroken, tmp_path))
    assert list(expected) == list(got)
    for column in expected:
        if column not in _CLOCKS:
            np.testing.assert_array_equal(got[column], expected[column], column)
    expected, got = (read_csv(each / "eval.csv") for each in (unbroken, tmp_path))
    np.testing.assert_array_equal(got["task_return_mean"], expected["task_return_mean"])


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("method", ["psil", "sil", "dac"])
def test_method_trains(method, tmp_path):
    flags = (*small_run(method, tmp_path), "--config.total_frames=2000")
    finished = call("launch", *flags)
    assert finished.returncode == 0, finished.stderr
    train = read_csv(tmp_path / "train.csv")
    assert len(train["frame"]) == 2
    if method == "dac":
        assert np.all(np.isfinite(train["discriminator/expert_logit"][1:]))
    else:
        # The first episode is scaled to minus ten, and the scale then stays.
        assert train["imitation_return"][0] == pytest.approx(-10.0, rel=1e-4)
        assert len(set(train["sinkhorn/scale"])) == 1
        filmed = _filmed(tmp_path)
        assert filmed["plan"].shape == (101, 101)
        np.testing.assert_allclose(filmed["plan"].sum(axis=1), 1 / 101, rtol=1e-3)
        for name in ("agent_strip", "expert_strip"):
            assert filmed[name].shape == (10, 24, 24, 3)


@pytest.mark.usefixtures("plain")
def test_cloning_learns_without_playing(tmp_path):
    finished = call(
        "launch",
        *small_run("bc", tmp_path),
        "--config.total_frames=3000",
        "--config.update_every_steps=1",
        "--config.learning_rate=3e-3",
    )
    assert finished.returncode == 0, finished.stderr
    train = read_csv(tmp_path / "train.csv")
    # Of an actor that does nothing, where the expert pushes with full force, at a
    # standard deviation of 0.1: 1 / (2 * 0.1^2) - 1.4, about 45 in the mean.
    assert train["actor/loss"][-1] < 10
    assert not np.any(np.isfinite(train["task_return"]))
    np.testing.assert_array_equal(
        read_csv(tmp_path / "eval.csv")["frame"], [2000, 3000]
    )


@pytest.mark.usefixtures("plain")
def test_state_expert_is_recorded_and_imitated(tmp_path):
    expert = tmp_path / "expert"
    trained = call(
        "launch",
        "--config=configs/expert.py:cartpole_swingup",
        "--config.total_frames=1000",
        "--config.seed_frames=500",
        "--config.action_repeat=10",
        "--config.hidden_dim=16",
        "--config.num_eval_episodes=1",
        f"--workdir={expert}",
    )
    assert trained.returncode == 0, trained.stderr
    train = read_csv(expert / "train.csv")
    np.testing.assert_array_equal(train["imitation_return"], train["task_return"])
    output = tmp_path / "demonstrations.npz"
    recorded = call(
        "collect", f"--workdirs={expert}", f"--output={output}", "--num_episodes=2"
    )
    assert recorded.returncode == 0, recorded.stderr
    imitated = call(
        "launch",
        *small_run("pdac", tmp_path / "agent"),
        "--config.task=cartpole_swingup",
        f"--config.demonstrations.source={output}",
        "--config.total_frames=1000",
    )
    assert imitated.returncode == 0, imitated.stderr
    output.unlink()
    evaluated = call("evaluate", f"--workdir={tmp_path / 'agent'}", "--num_episodes=1")
    assert evaluated.returncode == 0, evaluated.stderr
    assert (
        f"the video is without the expert: {output} cannot be read" in evaluated.stderr
    )
    assert "the expert's" not in evaluated.stdout


def _exported(folder, observations):
    """Acts with an exported policy, where jaxil cannot be imported."""
    np.save(folder / "observations.npy", observations)
    script = (
        "import sys; sys.path.insert(0, '.'); sys.modules['jaxil'] = None\n"
        "import numpy as np, reader\n"
        "np.save('actions.npy', reader.act(np.load('observations.npy')))"
    )
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", script]
    subprocess.run(command, check=True, cwd=folder, env=environment, timeout=240)
    return np.load(folder / "actions.npy")


def _filmed(workdir):
    newest = max((workdir / "videos").glob("*.npz"))
    with np.load(newest) as arrays:
        return dict(arrays)


def _start(*flags: str) -> subprocess.Popen:
    """Starts a run whose output, errors included, goes to one pipe."""
    return subprocess.Popen(
        arguments("launch", *flags),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
