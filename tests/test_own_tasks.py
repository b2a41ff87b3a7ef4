"""Tasks that are not of the control suite, as people type them."""

import csv
import os
import re
import textwrap

import numpy as np
import pytest

import jaxil
from jaxil import collect
from jaxil.config import default_config
from jaxil.demonstrations import foreign, states
from jaxil.environments import tasks
from jaxil.errors import UsageError
from jaxil.training import expert_distance, workdir
from tests.commands import ROOT, call, run, small

# A package of one file, as a user would write it: a light that can be pushed around.
_OWN = """
import dm_env
import numpy as np
from dm_env import specs


class Light(dm_env.Environment):
    step_limit = 12

    def __init__(self):
        self.rng = np.random.default_rng(0)

    def seed(self, number):
        self.rng = np.random.default_rng(number)

    def reset(self):
        self.place, self.time = self.rng.uniform(-1.0, 1.0), 0
        return dm_env.restart(self.image())

    def step(self, action):
        self.time += 1
        self.place = float(np.clip(self.place + action[0] / 10, -1.0, 1.0))
        reward = 1.0 - abs(self.place)
        if self.time == self.step_limit:
            return dm_env.truncation(reward, self.image())
        return dm_env.transition(reward, self.image())

    def image(self):
        image = np.zeros((20, 30, 3), np.uint8)
        column = round((self.place + 1.0) / 2.0 * 24)
        image[8:14, column : column + 6] = 255
        return image

    def observation_spec(self):
        return specs.Array((20, 30, 3), np.uint8)

    def action_spec(self):
        return specs.BoundedArray((1,), np.float64, -2.0, 2.0)


class Square(Light):
    def image(self):
        return np.pad(super().image(), ((5, 5), (0, 0), (0, 0)))


class Unrewarded(Light):
    def step(self, action):
        return super().step(action)._replace(reward=float("nan"))


def make():
    return Light()


def far(image):
    return np.array([5.0])


def lost(image):
    return np.array([np.nan])


def centre(image):
    columns = np.nonzero(image.max(axis=(0, 2)) > 100)[0]
    return np.clip([1.0 - columns.mean() * 2.0 / image.shape[1]], -1.0, 1.0)


def lean(state):  # lets the pole fall: episodes of some thirty steps
    return np.clip([0.05 * state[1]], -1.0, 1.0)


def hinge():
    from dm_control import composer, mjcf
    from dm_control.composer.observation import observable

    class Arm(composer.Entity):
        def _build(self):
            self.model = mjcf.RootElement("arm")
            body = self.model.worldbody.add("body")
            self.joint = body.add("joint", type="hinge", axis=(0, 1, 0))
            size, colour = (0.05, 0.3), (1, 0, 0, 1)
            body.add("geom", type="capsule", size=size, rgba=colour)
            self.model.actuator.add("motor", joint=self.joint, ctrlrange=(-2, 2))
            settings = {"pos": (0, -2, 0), "xyaxes": (1, 0, 0, 0, 0, 1)}
            self.model.worldbody.add("camera", name="side", **settings)

        mjcf_model = property(lambda self: self.model)

    class Swing(composer.Task):
        def __init__(self):
            self.arm = Arm()
            self.set_timesteps(0.02, 0.01)

        root_entity = property(lambda self: self.arm)

        @property
        def task_observables(self):
            angle = observable.MJCFFeature("qpos", self.arm.joint)
            angle.enabled = True
            return {"angle": angle}

        def initialize_episode(self, physics, random_state):
            physics.bind(self.arm.joint).qpos = random_state.uniform(-2, 2)

        def get_reward(self, physics):
            return np.cos(physics.bind(self.arm.joint).qpos).item()

    return composer.Environment(Swing(), time_limit=0.2)
"""
_SIZES = (
    "--config.action_repeat=2",
    "--config.seed_frames=40",
    "--config.exploration_steps=10",
    "--config.eval_every_frames=40",
    "--config.checkpoint_every_frames=40",
)


@pytest.fixture(autouse=True)
def _package(tmp_path, monkeypatch):
    (tmp_path / "light.py").write_text(textwrap.dedent(_OWN))
    monkeypatch.syspath_prepend(tmp_path)
    path = os.pathsep.join((str(tmp_path), str(ROOT)))
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.setattr(expert_distance, "_RANDOM_EPISODES", 1)


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("task", "policy"),
    [
        ("gymnasium:InvertedPendulum-v5", "light:lean"),
        ("light:make", "light:centre"),
    ],
)
def test_a_function_plays_and_is_recorded(task, policy, tmp_path, capsys):
    record(task, policy, tmp_path / "expert.npz")
    assert "2 episodes" in capsys.readouterr().out
    recording = foreign.open_recording(tmp_path / "expert.npz", max_bytes=2**24)
    assert (recording.task, recording.action_repeat) == (task, 2)
    episode = next(recording.episodes)
    assert episode.frames.shape[1:] == (24, 24, 3)
    assert episode.frames.std() > 0
    assert episode.actions is not None


def test_a_square_image_is_recorded_as_the_task_draws_it(tmp_path):
    """Resized twice it would differ from what the agent sees in the same state."""
    record("light:Square", "light:centre", tmp_path / "expert.npz", image_size=())
    recording = foreign.open_recording(tmp_path / "expert.npz", max_bytes=2**24)
    frames = next(recording.episodes).frames
    assert frames.shape[1:] == (30, 30, 3)
    assert set(np.unique(frames)) == {0, 255}  # no grey of a resized edge


@pytest.mark.parametrize(
    ("task", "policy", "message"),
    [
        ("light:make", "light:far", "returned [5.] at step 0, not in [-1, 1]"),
        ("light:make", "light:lost", "returned [nan] at step 0, not in [-1, 1]"),
        ("light:Unrewarded", "light:centre", "reward is nan after step 0"),
    ],
)
def test_what_no_run_could_read_is_not_recorded(task, policy, message, tmp_path):
    with pytest.raises(UsageError, match=re.escape(message)):
        record(task, policy, tmp_path / "expert.npz")
    assert not (tmp_path / "expert.npz").exists()


# tests/test_adoption.py does the same with a task of Gymnasium.
def test_a_task_from_outside_is_trained_resumed_and_shown(tmp_path):
    expert, workdir = tmp_path / "expert.npz", tmp_path / "runs" / "1"
    record("light:make", "light:centre", expert)
    flags = (
        "--config=configs/tiny.py:zero,light:make",
        f"--workdir={workdir}",
        *small("zero"),
        *_SIZES,
        f"--config.demonstrations.source={expert}",
    )
    for total in (60, 120):
        finished = call("launch", *flags, f"--config.total_frames={total}")
        assert finished.returncode == 0, finished.stderr
    assert "resuming from the checkpoint" in finished.stderr
    frames = [int(row["frame"]) for row in rows(workdir / "train.csv")]
    assert frames == sorted(set(frames))
    assert frames[-1] >= 120
    assert list((workdir / "videos").glob("frame_*.mp4"))
    assert float(rows(workdir / "eval.csv")[-1]["expert_task_return_mean"]) > 0

    # The folder alone may not make Python import anything.
    words = (f"--workdir={workdir}", "--num_episodes=1")
    refused = run("evaluate", *words)
    assert refused.returncode == 2
    assert "--trust=light:make" in refused.stderr
    evaluated = call("evaluate", *words, "--trust=light:make")
    assert evaluated.returncode == 0, evaluated.stderr
    assert "the expert's mean" in evaluated.stdout
    reported = call("report", str(workdir.parent), f"--output={tmp_path / 'report'}")
    assert reported.returncode == 0, reported.stderr
    assert "light:make" in (tmp_path / "report" / "index.html").read_text()


def record(task, policy, path, image_size=("--image_size=24",)):
    collect.main(
        [
            "collect",
            f"--policy={policy}",
            f"--task={task}",
            f"--output={path}",
            "--num_episodes=2",
            *image_size,
        ]
    )


def test_faults_of_tasks_are_one_message_each():
    for task, words in (
        ("gymnasium:Hoper-v5", "Hopper"),
        ("gymnasium:CartPole-v1", "Discrete"),
        ("light:nothing", "has no attribute 'nothing'"),
        ("no_such_module:make", "PYTHONPATH"),
        ("light:centre", "missing 1 required positional argument"),
    ):
        found = _problems(task)
        assert len(found) == 1
        assert words in found[0], found
    assert "dm_control" in _problems("light:make", camera="side")[0]


@pytest.mark.parametrize("task", ["harm:make", "gymnasium:harm:Harm-v0"])
def test_a_folder_or_file_alone_makes_python_import_nothing(task, tmp_path):
    (tmp_path / "harm.py").write_text("raise SystemExit('imported')")
    config = default_config("zero")
    config.task = task
    workdir.write_config(tmp_path, config, {})
    workdir.read_config(tmp_path, imports_task=False)  # trusts nothing
    with pytest.raises(UsageError, match=f"--trust={task}"):
        workdir.read_config(tmp_path)
    stored = states.read_states(states.shipped_path("cartpole_swingup"), num_episodes=1)
    stored = stored._replace(metadata={**stored.metadata, "task": task})
    states.write_states(tmp_path / "states.npz", stored)
    with pytest.raises(UsageError, match=f"--trust={task}"):
        collect.main(["collect", f"--inspect={tmp_path / 'states.npz'}"])
    jaxil.trust(task)
    assert workdir.read_config(tmp_path).task == task


def _problems(task, **changes):
    settings = {
        "image_size": 24,
        "observation": "pixels",
        "render_quality": "paper",
        "camera": "",
        "distraction": "none",
    }
    return [str(fault) for fault in tasks.problems(task, **(settings | changes))]


def test_pixels_are_scaled_and_starts_depend_on_seed_and_number_alone():
    environment = tasks.make_environment("light:make", seed=3, image_size=16)
    starts = [environment.reset(episode=episode).observation for episode in (5, 6, 5)]
    assert starts[0].shape == (16, 16, 9)
    np.testing.assert_array_equal(starts[0], starts[2])
    assert not np.array_equal(starts[0], starts[1])


def test_a_task_of_composer_is_seeded_rendered_and_cut_off():
    assert _problems("light:hinge", camera="side") == []
    assert "0 side" in _problems("light:hinge", camera="front")[0]
    assert "suite" in _problems("light:hinge", distraction="easy")[0]
    environment = tasks.make_environment("light:hinge", seed=3, image_size=16)
    assert environment.episode_steps == 5
    starts = [environment.reset(episode=episode).observation for episode in (5, 6, 5)]
    np.testing.assert_array_equal(starts[0], starts[2])
    assert not np.array_equal(starts[0], starts[1])
    steps = [environment.step(np.ones(1)) for _ in range(5)]
    assert [step.last() for step in steps] == [False] * 4 + [True]
    assert steps[-1].discount == 1.0
    assert not np.array_equal(steps[-1].observation, starts[2])
    large = environment.render(64)  # as for films: rendered so, not scaled
    assert large.shape == (64, 64, 3)
    scaled = np.repeat(np.repeat(environment.render(), 4, axis=0), 4, axis=1)
    assert np.abs(large.astype(int) - scaled).max() > 50
    environment.close()


def test_environments_of_one_process_render_what_they_would_alone():
    def make(size):
        task = "gymnasium:InvertedPendulum-v5"
        environment = tasks.make_environment(task, seed=0, image_size=size)
        environment.reset(episode=0)
        return environment

    one = make(24)
    alone = [one.render()]
    one.step(np.ones(1))
    alone.append(one.render())
    assert alone[0].std() > 0
    assert not np.array_equal(alone[0], alone[1])
    one.reset(episode=0)
    other = make(32)
    shown = other.render()
    np.testing.assert_array_equal(one.render(), alone[0])
    one.step(np.ones(1))
    np.testing.assert_array_equal(other.render(), shown)
    other.close()
    np.testing.assert_array_equal(one.render(), alone[1])
    one.close()


@pytest.mark.parametrize(
    ("task", "discount"),
    [("gymnasium:InvertedPendulum-v5", 0.0), ("gymnasium:Reacher-v5", 1.0)],
)
def test_a_termination_has_discount_zero_and_a_truncation_one(task, discount):
    environment = tasks.make_environment(task, seed=0, observation="state")
    step = environment.reset(episode=0)
    while not step.last():
        assert step.discount in (None, 1.0)
        step = environment.step(np.ones(environment.action_spec().shape))
    assert step.discount == discount
    environment.close()
