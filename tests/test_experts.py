"""The controllers of launch/experts: their models, their search, what they record."""

import importlib
import runpy
import sys

import numpy as np
import pytest

from jaxil.demonstrations import states
from jaxil.environments.suite import SuiteEnvironment
from jaxil.environments.tasks import make_environment
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
    assert isinstance(frictionless, SuiteEnvironment)
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
    planner = importlib.import_module("acrobot")
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
    planner = importlib.import_module("acrobot")
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
    ("script", "flags", "named"),
    [
        ("acrobot.py", ("--output=FOLDER/a.npz", "--num_episodes=0"), "num_episodes"),
        ("acrobot.py", ("--output=/proc/missing/a.npz",), "/proc: "),
        ("acrobot.py", ("--output=FOLDER",), "is a folder"),
        ("cheetah.py", ("--output=FOLDER/a.npz",), "--workdir"),
        ("cheetah.py", ("--output=FOLDER/a.npz", "--workdir=FOLDER/none"), "none"),
    ],
)
def test_wrong_use_is_one_sentence(script, flags, named, tmp_path, monkeypatch, capsys):
    words = [flag.replace("FOLDER", str(tmp_path)) for flag in flags]
    monkeypatch.setattr(sys, "argv", [script, *words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(_FOLDER / script), run_name="__main__")
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert named in printed
    said = [line for line in printed.splitlines() if not line.startswith("jax on")]
    assert len(said) == 1
    assert not list(tmp_path.iterdir())


# Cheetah -----------------------------------------------------------------------


@pytest.fixture
def cheetah():
    module = importlib.import_module("cheetah_search")
    made = make_environment("cheetah_run", seed=777, observation="state")
    assert isinstance(made, SuiteEnvironment)
    made.reset(episode=1)
    start = made.simulator_state()
    start["qvel"][0] = 3.0  # m/s: what does not run earns nothing
    made.set_simulator_state(**start)
    yield made, module.Simulator(made.physics), module
    made.close()


def test_cheetah_simulator_goes_where_the_environment_goes(cheetah):
    environment, simulator, _ = cheetah
    rng = np.random.default_rng(0)
    actions = np.sign(rng.uniform(-1, 1, (2, 25, 6)))
    states, rewards = simulator.run(simulator.now(), actions)
    told = []
    for state, action in zip(states[1], actions[1], strict=True):
        timestep = environment.step(action)
        np.testing.assert_allclose(simulator.now(), state, atol=1e-9)
        np.testing.assert_allclose(
            simulator.observe(state), timestep.observation, atol=1e-6
        )
        told.append(timestep.reward)
    # Each of its rewards is that of the frame before.
    assert sum(told) > 1.0
    assert rewards[1].sum() == pytest.approx(sum(told), abs=0.2)
    assert not np.allclose(states[0, -1], states[1, -1])


def test_cheetah_search_beats_the_policy_it_starts_from(cheetah):
    _, simulator, module = cheetah

    def judge(observations):  # stands still, and expects nothing
        return np.zeros((len(observations), 6)), np.zeros(len(observations))

    effort = module.Effort(horizon=8, candidates=32, rounds=3)
    state, rng = simulator.now(), np.random.default_rng(0)
    planner = module.Planner(simulator, judge, 0.99, effort)
    usual = planner.follow(state)
    np.testing.assert_array_equal(usual, np.zeros((8, 6)))
    plan = planner.search(state, None, rng)
    idle, found = planner.score(state, np.stack([usual, plan]))
    assert found > idle + 0.1
    assert np.abs(plan).max() <= 1.0


def test_cheetah_score_by_hand(cheetah):
    _, simulator, module = cheetah
    values = iter([np.array([3.0])])
    state, actions = simulator.now(), np.zeros((1, 2, 6))
    rewards = simulator.run(state, actions)[1][0]
    judge = lambda seen: (np.zeros((1, 6)), next(values))  # noqa: E731
    planner = module.Planner(simulator, judge, 0.5, module.Effort())
    total = planner.score(state, actions)
    assert total[0] == pytest.approx(rewards[0] + 0.5 * rewards[1] + 0.25 * 3.0)
