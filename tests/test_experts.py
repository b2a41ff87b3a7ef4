"""The controllers of launch/experts: their model, their search, what they record."""

import importlib
import subprocess
import sys

import numpy as np
import pytest

from jaxil.host import states
from jaxil.host.environment import make_environment
from tests.commands import ROOT

_FOLDER = ROOT / "launch" / "experts"


@pytest.fixture(scope="module", autouse=True)
def scripts():
    """Lets the scripts find each other, as when one of them is run."""
    sys.path.insert(0, str(_FOLDER))
    yield
    sys.path.remove(str(_FOLDER))


@pytest.fixture(scope="module")
def environment():
    made = make_environment(
        "acrobot_swingup", seed=777, action_repeat=2, observation="state"
    )
    yield made
    made.close()


def _arm(environment):
    return importlib.import_module("acrobot_model").Arm(environment.physics)


def _state(environment):
    now = environment.simulator_state()
    return np.concatenate([now["qpos"], now["qvel"]])


def test_acrobot_equations_are_the_simulators(environment):
    task_reward = importlib.import_module("acrobot_model").task_reward
    arm, rng = _arm(environment), np.random.default_rng(0)
    environment.reset(episode=3)
    state = tuple(_state(environment)[:, None])
    rewards = 0.0
    for _ in range(100):
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        timestep, reward = environment.step(action), 0.0
        for _ in range(2):
            state = arm.step(state, action.astype(np.float64))
            reward += task_reward(*state[:2])[0]
        assert reward == pytest.approx(timestep.reward, abs=1e-9)
        rewards += reward
    np.testing.assert_allclose(np.ravel(state), _state(environment), atol=1e-8)
    assert rewards > 1.0  # else the comparison was one of zeros


def test_acrobot_energy_stays_without_friction_and_torque():
    # An environment of its own: its friction is taken away.
    frictionless = make_environment(
        "acrobot_swingup", seed=0, action_repeat=2, observation="state"
    )
    frictionless.physics.model.dof_damping[:] = 0
    arm = _arm(frictionless)
    frictionless.close()
    state = tuple(np.array([[2.0, -1.0], [1.0, 0.5], [0.5, -3.0], [-1.0, 4.0]]))
    before = arm.energy(state)
    for _ in range(200):
        state = arm.step(state, np.zeros(2))
    np.testing.assert_allclose(arm.energy(state), before, atol=1e-3)
    assert arm.energy(tuple(np.zeros((4, 1))))[0] == pytest.approx(2 * 9.81)


def test_acrobot_regulator_holds_what_falls_alone(environment):
    planner = importlib.import_module("acrobot_planner")
    arm = _arm(environment)
    gains = np.array([[1.0, 1, 0, 1, 0, 1, 1, 30]]).T
    start = tuple(np.array([[0.005], [-0.005], [0.0], [0.0]]))
    held = fallen = start
    for _ in range(400):
        held = arm.step(held, planner.control(arm, held, gains))
        fallen = arm.step(fallen, np.zeros(1))
    assert np.abs(held).max() < 1e-3
    assert np.abs(fallen).max() > 1.0


def test_acrobot_search_never_gives_up_better_gains(environment):
    planner = importlib.import_module("acrobot_planner")
    arm = _arm(environment)
    environment.reset(episode=0)
    state, steps = _state(environment), 60
    effort = planner.Effort(draws=50, variations=20, rounds=2, exact=3)
    rng = np.random.default_rng(1)
    gains, coming = planner.search(arm, state, None, steps, effort, rng)
    poor = planner.Effort(draws=1, variations=1, rounds=1, exact=1)
    kept, at_least = planner.search(arm, state, gains, steps, poor, rng)
    assert at_least >= coming - 1e-9
    predicted = planner.predict(arm, state, kept[:, None], steps, exact=True)
    assert predicted[0] == pytest.approx(at_least)
    middling = planner.predict(arm, state, gains[:, None], steps, exact=False)
    assert middling[0] == pytest.approx(coming, rel=0.1)  # in 1.2 s chaos is small


def test_acrobot_record_is_what_its_actions_do(environment, tmp_path, monkeypatch):
    acrobot = importlib.import_module("acrobot")
    monkeypatch.setattr(acrobot, "_SEARCH_EVERY_STEPS", 250)  # for speed
    effort = acrobot.Effort(draws=300, variations=100, rounds=1, exact=10)
    path = tmp_path / "acrobot.npz"
    states.write_states(path, acrobot.record(1, first=effort, later=effort))
    stored = states.read_states(path, task="acrobot_swingup")
    assert stored.rewards.shape == (1, 500)
    assert np.abs(stored.actions).max() <= 1.0
    environment.reset(episode=0)
    for step, action in enumerate(stored.actions[0]):
        now = environment.simulator_state()
        np.testing.assert_array_equal(now["qpos"], stored.qpos[0, step])
        np.testing.assert_array_equal(now["qvel"], stored.qvel[0, step])
        reward = environment.step(action).reward
        assert np.float32(reward) == stored.rewards[0, step]
    environment.reset(episode=0)
    idle = sum(environment.step(np.zeros(1)).reward for _ in range(500))
    assert stored.rewards.sum() > idle + 100


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--output=FOLDER/a.npz", "--num_episodes=0"), "num_episodes"),
        (("--output=FOLDER/missing/a.npz",), "missing"),
        (("--output=FOLDER",), "is a folder"),
    ],
)
def test_wrong_use_of_an_expert_is_one_sentence(flags, named, tmp_path):
    words = [flag.replace("FOLDER", str(tmp_path)) for flag in flags]
    ended = subprocess.run(
        [sys.executable, str(_FOLDER / "acrobot.py"), *words],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ended.returncode == 2
    assert named in ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
