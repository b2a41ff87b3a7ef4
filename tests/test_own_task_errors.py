"""Tasks of one's own that fail, end too soon or contradict their specs in a run."""

import json

import dm_env
import numpy as np
import pytest
from dm_env import specs

from jaxil import config as jaxil_config
from jaxil.environments import tasks
from jaxil.training import assembly
from tests.commands import STATES, call, small, small_run
from tests.own_task import Task


def test_an_episode_that_replay_or_updates_cannot_use_is_said(monkeypatch):
    task = Task()
    task.step_limit = 5000  # pyright: ignore[reportAttributeAccessIssue]
    name = f"{__name__}:long"
    monkeypatch.setitem(globals(), "long", lambda: task)
    config = jaxil_config.default_config("drqv2", name)
    config.update(action_repeat=2, total_frames=10_000, replay_size_steps=2_000)
    (fault,) = assembly.problems(config)
    assert "less than an episode, which has 2500 agent steps" in str(fault)
    config.max_episode_frames = 4_000
    assert assembly.problems(config) == []
    config.max_episode_frames, config.num_steps = 10, 6
    (fault,) = assembly.problems(config)
    assert "num_steps=6 is more than an episode, which has 5 agent steps" in str(fault)


def test_a_task_is_made_once_to_be_checked(monkeypatch):
    """It may hold a port or a robot."""
    made = []
    monkeypatch.setitem(globals(), "single", lambda: made.append(Task()) or made[-1])
    config = jaxil_config.default_config("drqv2", f"{__name__}:single")
    assert assembly.problems(config) == []
    assert len(made) == 1


def test_a_run_without_an_update_says_so(monkeypatch, tmp_path):
    """Its episodes end before n-step returns begin, which no spec tells."""

    class Short(Task):
        step_limit = 200

        def step(self, action):
            return dm_env.termination(0.0, self._image)

    monkeypatch.setitem(globals(), "short", Short)
    flags = (f"--config=drqv2:{__name__}:short", *small("drqv2"))
    few = ("--config.action_repeat=2", "--config.total_frames=20")
    ended = call("launch", *flags, *few, f"--workdir={tmp_path}")
    assert ended.returncode == 0, ended.stderr
    assert "nothing was learned" in ended.stderr


@pytest.mark.parametrize("function", ["reset", "step"])
def test_what_gymnasium_would_return_is_named(function, monkeypatch):
    class Tuples(Task):
        pass

    setattr(Tuples, function, lambda *_: (np.zeros((8, 8, 3), np.uint8), {}))
    monkeypatch.setitem(globals(), "tuples", Tuples)
    config = jaxil_config.default_config("drqv2", f"{__name__}:tuples")
    (fault,) = assembly.problems(config)
    assert f"{function}() returned tuple; it must return a dm_env.TimeStep" in str(
        fault
    )


def test_an_action_of_another_shape_is_the_policys(monkeypatch, tmp_path):
    monkeypatch.setitem(globals(), "short", lambda: Task())
    monkeypatch.setitem(globals(), "three", lambda observation: np.zeros(3))
    names = (f"--policy={__name__}:three", f"--task={__name__}:short")
    ended = call("collect", *names, f"--output={tmp_path}/a.npz", "--num_episodes=1")
    assert ended.returncode == 2
    assert "returned shape (3,); the task takes (1,)" in ended.stderr


def test_a_state_is_as_long_as_its_spec_says(monkeypatch):
    class Longer(Task):
        def observation_spec(self):
            return specs.Array((3,), np.float64)

    monkeypatch.setitem(globals(), "longer", lambda: Longer(image=np.zeros(5)))
    environment = tasks.make_environment(
        f"{__name__}:longer", seed=0, observation="state"
    )
    with pytest.raises(ValueError, match="observes 5 numbers, but its spec says 3"):
        environment.reset()


@pytest.mark.parametrize("error", [FloatingPointError("NaN"), SystemExit(3)])
@pytest.mark.parametrize("command", ["launch", "benchmark"])
def test_an_error_in_a_step_is_one_message(command, error, monkeypatch, tmp_path):
    class Exploding(Task):
        step_limit, steps = 200, 0

        def step(self, action):
            self.steps += 1
            if self.steps > 5:
                raise error
            return super().step(action)

    monkeypatch.setitem(globals(), "exploding", Exploding)
    flags = (f"--config=drqv2:{__name__}:exploding", *small("drqv2"))
    own = [f"--workdir={tmp_path}"] if command == "launch" else ["--nostart"]
    ended = call(command, *flags, *own, "--config.action_repeat=2")
    assert ended.returncode == 1
    said = ended.stdout + ended.stderr
    assert f"the task raised an error in a{'' if command == 'launch' else 'n'} " in said
    assert f"{type(error).__name__}: {error} (test_own_task_errors.py, line" in said
    assert "Traceback" not in said


@pytest.fixture(name="trained", scope="module")
def _trained(tmp_path_factory):
    """A run's folder and the content of its config.json."""
    folder = tmp_path_factory.mktemp("trained")
    silent = "--config.video_every_evals=0"
    finished = call("launch", *small_run("zero", folder), *STATES, silent)
    assert finished.returncode == 0, finished.stderr
    return folder, json.loads((folder / "config.json").read_text())


@pytest.mark.parametrize(
    ("change", "value", "said"),
    [
        ("task", "cup_catch", "task='cup_catch' is unknown"),
        ("task", "walker_walk", "walker_walk has observations (24,), the policy"),
        ("hidden_dim", 7, "does not fit the checkpoint"),
        ("observation", "pixels", "does not fit the checkpoint"),
    ],
)
@pytest.mark.parametrize("command", ["evaluate", "collect"])
def test_a_config_that_does_not_fit_the_run_is_one_message(
    command, change, value, said, trained
):
    """Whoever edits config.json by hand is told so."""
    folder, stored = trained
    config = stored["config"] | {change: value}
    (folder / "config.json").write_text(json.dumps(stored | {"config": config}))
    flags = {"evaluate": [f"--workdir={folder}"], "collect": [f"--workdirs={folder}"]}
    output = [f"--output={folder}/out.npz"] if command == "collect" else []
    ended = call(command, *flags[command], *output)
    assert ended.returncode == 2
    assert said in ended.stderr
