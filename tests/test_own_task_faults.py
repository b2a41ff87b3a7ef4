"""Tasks of one's own that give what no agent can use: one message each."""

import itertools
import os
import pathlib
from unittest import mock

import numpy as np
import pytest
from dm_env import specs

from jaxil.demonstrations import foreign
from jaxil.environments import tasks
from jaxil.environments.pixel_environment import PixelEnvironment
from tests.commands import call, small
from tests.own_task import BLACK, Task, bounded

ROOT = pathlib.Path(__file__).parent.parent
_NUMBERS = itertools.count()


@pytest.mark.parametrize(
    ("faulty", "words"),
    [
        (lambda: Task(bounded([], [])), "needs a bounded vector"),
        (lambda: Task(reward=None), "reward is None; it must be a number, 0 in"),
        (lambda: Task(reward="much"), "reward is 'much'"),
        (lambda: Task(discount=None), "discount is None; it must lie in [0, 1]"),
        (lambda: Task(discount=1.5), "discount is 1.5"),
        (lambda: Task(image=np.zeros((8, 8))), "it observes float64[8, 8]"),
        (lambda: Task(image=BLACK / 2.0), "it observes float64[8, 8, 3]"),
        (lambda: Task(image={}), "it observes nothing"),
        (lambda: Task(image={"a": [1, [2, 3]], "b": None}), "list, NoneType"),
        (lambda: Task(bounded([-1, 0], [1, np.inf])), "one limit alone"),
        (lambda: Task(bounded([-1, np.nan], [1, 1])), "NaN among the limits"),
        (lambda: Task(specs.Array((1,), np.float64)), "needs a bounded vector"),
    ],
)
def test_what_cannot_be_used_is_named(faulty, words, monkeypatch):
    monkeypatch.setitem(globals(), "faulty", faulty)
    (fault,) = tasks.problems(f"{__name__}:faulty", **settings())
    assert words in str(fault)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_have_the_range_and_type_of_the_task(dtype, monkeypatch):
    task = Task(bounded([0, -np.inf], [4, np.inf], dtype))
    monkeypatch.setitem(globals(), "of_type", lambda: task)
    environment = tasks.make_environment(f"{__name__}:of_type", seed=0)
    environment.reset()
    environment.step(np.array([0.5, 0.5], np.float32))
    assert task.taken.dtype == dtype
    np.testing.assert_array_equal(task.taken, [3.0, 0.5])  # no limit: [-1, 1]


@pytest.mark.parametrize("name", ["step_limit", "frame_seconds"])
@pytest.mark.parametrize("value", [lambda: 10, "10", -1])
def test_numbers_that_a_task_offers_are_numbers(name, value, monkeypatch):
    task = Task()
    setattr(task, name, value)
    monkeypatch.setitem(globals(), "offering", lambda: task)
    with pytest.raises(ValueError, match=f"has {name}=.*number above 0"):
        _ = tasks.make_environment(f"{__name__}:offering", seed=0).step_seconds
    closed = mock.create_autospec(task.close)
    task.close = closed
    (fault,) = tasks.problems(f"{__name__}:offering", **settings())
    closed.assert_called_once()
    assert f"has {name}=" in str(fault)


def test_whole_numbers_are_rounded_to(monkeypatch):
    task = Task(bounded([0, 0], [4, 4], np.int32))
    monkeypatch.setitem(globals(), "whole", lambda: task)
    environment = tasks.make_environment(f"{__name__}:whole", seed=0)
    environment.reset()
    environment.step(np.array([0.4, 0.2], np.float32))
    assert task.taken.dtype == np.int32
    np.testing.assert_array_equal(task.taken, [3, 2])


def test_a_reward_that_is_not_finite_does_not_end_a_run():
    """The agent never reads it; only the tables show it."""
    task = Task(reward=np.nan)
    environment = begun(task)
    assert np.isnan(environment.step(np.zeros(1)).reward)


def test_images_have_one_size():
    task = Task()
    environment = begun(task)
    task._image = np.zeros((10, 8, 3), np.uint8)
    with pytest.raises(ValueError, match=r"\(10, 8, 3\) images, but at first \(8, 8"):
        environment.step(np.zeros(1))


@pytest.mark.parametrize("error", [ValueError("no light"), SystemExit("no light")])
def test_an_error_of_the_task_says_where_it_is(error, monkeypatch):
    def failing():
        raise error

    monkeypatch.setitem(globals(), "failing", failing)
    (fault,) = tasks.problems(f"{__name__}:failing", **settings())
    said = f"{type(error).__name__}: no light (test_own_task_faults.py, line "
    assert said in str(fault)


def test_an_error_in_mid_episode_ends_a_run_in_one_message(monkeypatch, tmp_path):
    class Exploding(Task):
        step_limit, time = 12, 0

        def step(self, action):
            self.time += 1
            if self.time > 20:
                raise FloatingPointError("NaN in the simulation")
            return super().step(action)

    monkeypatch.setitem(globals(), "exploding", Exploding)
    task = f"{__name__}:exploding"
    flags = (f"--config=drqv2:{task}", *small("drqv2"), f"--workdir={tmp_path}")
    ended = call("launch", *flags, "--config.action_repeat=1")
    assert ended.returncode == 1
    assert "training stopped: the task raised an error in a step" in ended.stderr
    assert "NaN in the simulation (test_own_task_faults.py, line " in ended.stderr
    assert "there is none. Rerun the same command to start anew" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (
            lambda seen: {}["left"],
            "the policy raised an error in step 0: KeyError: 'left'",
        ),
        (lambda seen: np.zeros(1), "the task raised an error in a step: FloatingPoint"),
    ],
)
def test_what_fails_while_it_is_recorded_is_one_message(
    policy, words, monkeypatch, tmp_path
):
    class Exploding(Task):
        def step(self, action):
            raise FloatingPointError("NaN in the simulation")

    monkeypatch.setitem(globals(), "exploding", Exploding)
    monkeypatch.setitem(globals(), "policy", policy)
    output = tmp_path / "expert.npz"
    names = (f"--policy={__name__}:policy", f"--task={__name__}:exploding")
    ended = call("collect", *names, f"--output={output}")
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith(words)
    assert "(test_own_task_faults.py, line " in ended.stderr
    assert not list(tmp_path.iterdir())


class Counted(Task):
    """Writes down when it is made and when it is closed."""

    step_limit = 6

    def __init__(self):
        super().__init__()
        self._number = next(_NUMBERS)
        self._write("made")

    def close(self):
        self._write("closed")

    def _write(self, word):
        with pathlib.Path(os.environ["JAXIL_TEST_COUNTED"]).open("a") as file:
            file.write(f"{word} {os.getpid()} {self._number}\n")


def counted():
    return Counted()


def still(observation):
    del observation
    return np.zeros(1)


@pytest.mark.parametrize("num_environments", [1, 2])
def test_every_environment_is_closed(num_environments, tmp_path, monkeypatch):
    """Own tasks may hold a server, a licence or a window."""
    task, events = f"{__name__}:counted", tmp_path / "events"
    monkeypatch.setenv("JAXIL_TEST_COUNTED", str(events))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    run, trust, n = tmp_path / "run", f"--trust={task}", "--config.num_steps=1"
    train = (f"--config=drqv2:{task}", *small("drqv2"), n, f"--workdir={run}")
    several = f"--config.num_environments={num_environments}"
    output = f"--output={tmp_path / 'expert.npz'}"
    once = ("--repeats=1", "--steps=2", "--nostart")
    recorded = (f"--policy={__name__}:still", f"--task={task}", "--num_episodes=1")
    commands = [
        ("launch", *train, several),
        ("evaluate", f"--workdir={run}", "--num_episodes=1", trust),
        ("collect", f"--workdirs={run}", "--num_episodes=1", output, trust),
        ("collect", *recorded, f"--output={tmp_path / 'other.npz'}"),
        ("benchmark", *train[:-1], "--config.action_repeat=1", *once),
    ]
    if num_environments == 2:  # evaluation and recording take one
        commands = commands[:1]
    for command in commands:
        ended = call(*command)
        assert ended.returncode == 0, ended.stderr
        made, closed = set(), set()
        for line in events.read_text().splitlines():
            word, _, which = line.partition(" ")
            (made if word == "made" else closed).add(which)
        assert closed == made, command
    assert len({which.split()[0] for which in made}) == 1 + (
        num_environments if num_environments > 1 else 0
    )


def test_an_error_in_closing_a_task_hides_no_other(monkeypatch, tmp_path, caplog):
    class Stuck(Task):
        step_limit = 6

        def close(self):
            raise OSError("the simulator is gone")

    class Exploding(Stuck):
        def step(self, action):
            raise FloatingPointError("NaN in the simulation")

    for name, task in (("stuck", Stuck), ("exploding", Exploding)):
        monkeypatch.setitem(globals(), name, task)
        names = (f"--policy={__name__}:still", f"--task={__name__}:{name}")
        output = f"--output={tmp_path / name}.npz"
        ended = call("collect", *names, "--num_episodes=1", output)
        assert ended.returncode == (name == "exploding"), ended.stderr
        assert "in close(): OSError: the simulator is gone (test_own" in caplog.text
        caplog.clear()
        assert ("NaN in the simulation" in ended.stderr) == (name == "exploding")


def test_episodes_of_unequal_length_are_recorded_as_pixels(monkeypatch, tmp_path):
    """A file of simulator states has one length."""

    def falling():
        from dm_control.suite import cartpole

        environment, steps = cartpole.balance(), itertools.count()
        ends = {2, 6}  # episodes of 3, 4, 3, 4 ... steps
        environment.task.get_termination = lambda physics: (
            0.0 if next(steps) % 7 in ends else None
        )
        return environment

    monkeypatch.setitem(globals(), "falling", falling)
    names = (f"--policy={__name__}:still", f"--task={__name__}:falling")
    output = tmp_path / "out.npz"
    words = ("--action_repeat=1", "--num_episodes=2", "--image_size=16")
    ended = call("collect", *names, f"--output={output}", *words)
    assert ended.returncode == 0, ended.stderr
    assert "differ in length, so pixels are recorded" in ended.stderr
    assert "2 episodes" in ended.stdout
    recording = foreign.open_recording(output, max_bytes=2**24)
    assert [len(episode.frames) for episode in recording.episodes] == [4, 5]


def test_a_task_that_observes_images_alone_is_timed(monkeypatch):
    monkeypatch.setitem(globals(), "drawn", Task)
    flags = (f"--config=drqv2:{__name__}:drawn", *small("drqv2"))
    words = ("--config.action_repeat=100", "--repeats=1", "--steps=2", "--nostart")
    ended = call("benchmark", *flags, *words)
    assert ended.returncode == 0, ended.stderr
    assert "render_ms" in ended.stdout
    assert "physics_ms" not in ended.stdout


def begun(task):
    environment = PixelEnvironment(
        task,
        seed=0,
        action_repeat=1,
        image_size=8,
        frame_stack=1,
        observation="pixels",
    )
    environment.reset()
    return environment


def settings():
    return {
        "image_size": 8,
        "action_repeat": 1,
        "frame_stack": 1,
        "observation": "pixels",
        "render_quality": "paper",
        "camera": "",
        "distraction": "none",
    }
