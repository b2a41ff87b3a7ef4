"""Whole runs that are killed, stopped and resumed, with every kind of update.

The environment is a drawing that moves with the actions, so that nothing is simulated.
Most of the time goes into compiling: a minute of a core.
"""

import dataclasses
import types
from typing import Any

import jax
import numpy as np
import pytest

from jaxil import train
from jaxil.errors import TrainingDiverged, UsageError
from jaxil.files.tables import read_csv
from jaxil.maths.types import Episode
from jaxil.training import agent as agents
from jaxil.training import assembly, learning_curve, parts
from tests.environments.counting import InTurn
from tests.training.drawing import (
    EPISODES,
    STEPS,
    Drawing,
    make_agent,
    make_config,
    make_demonstrations,
)

CLOCKS = ("seconds", "frames_per_second", "reward_seconds")


@pytest.fixture(autouse=True)
def _nothing_is_simulated(monkeypatch):
    monkeypatch.setattr(assembly, "make_environment", lambda *_, **__: Drawing())
    monkeypatch.setattr(
        assembly, "Pool", lambda make, size, say: InTurn([make() for _ in range(size)])
    )
    monkeypatch.setattr(agents, "make_agent", lambda c, *_: make_agent(c.method))
    monkeypatch.setattr(learning_curve, "plot", lambda *_, **__: None)  # slow
    distance = types.SimpleNamespace(relative_distance=lambda *_, **__: None)
    monkeypatch.setattr(parts, "ExpertDistance", lambda *_: distance)


def make_run(folder, method="dac", **changes):
    folder.mkdir(exist_ok=True)
    config = make_config(method, **changes)
    return train.Run.make(config, folder, make_demonstrations())


def test_what_was_opened_is_closed_if_the_rest_fails(tmp_path, monkeypatch):
    closed, pools = [], []
    monkeypatch.setattr(Drawing, "close", lambda self: closed.append(self))

    def make_pool(make, size, say):
        del say
        pools.append(InTurn([make() for _ in range(size)]))
        return pools[0]

    monkeypatch.setattr(assembly, "Pool", make_pool)

    def fail(*_, **__):
        raise UsageError("no logger")

    monkeypatch.setattr(parts, "RunLog", fail)
    with pytest.raises(UsageError, match="no logger"):
        make_run(tmp_path / "run", num_environments=2)
    assert len(set(closed)) == 2  # that of evaluations, and the pool's model
    assert pools[0].tape == ["close"]


def act_until(run, num_steps):
    """Makes a run stop at an agent step; without `finish` that is like a kill."""
    act = run.act

    def act_and_stop(observations):
        run.stop_asked |= run.counters.num_steps >= num_steps
        return act(observations)

    run.act = act_and_stop
    return run


def finished(run):
    run.loop()
    run.finish()
    run.close()
    return run


def assert_same(run, other, tmp_path, *names):
    """Compares the tables, clocks left out, and what was learned."""
    for table in ("train.csv", "eval.csv"):
        ours, theirs = (read_csv(tmp_path / name / table) for name in names)
        assert table == "eval.csv" or len(theirs["frame"]) == EPISODES
        for column in set(theirs) - set(CLOCKS):
            np.testing.assert_array_equal(ours[column], theirs[column], column)
    leaves = [jax.tree.leaves(r.state.params) for r in (run, other)]
    for ours, theirs in zip(*leaves, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_frames_on_the_device_change_no_number(tmp_path):
    # DAC samples all that there is to sample: windows, experts, and their actions.
    here = finished(make_run(tmp_path / "here"))
    there = finished(make_run(tmp_path / "there", replay_on_device=True))
    assert there.state.num_updates == STEPS * (EPISODES - 1) == 84
    assert_same(there, here, tmp_path, "there", "here")
    assert _compilations(there.agent.update_step) == 2  # one of each run


def test_groups_of_updates_end_with_the_episode_and_resume_bit_for_bit(tmp_path):
    changes = {"replay_on_device": True, "updates_per_dispatch": 4}
    unbroken = make_run(tmp_path / "unbroken", **changes)
    updates: Any = unbroken.updates
    read, sizes, run_group = [], [], updates.run

    def counting_run(state):
        before = int(state.num_updates)
        state, metrics = run_group(state)
        if int(state.num_updates) > before:
            sizes.append(int(state.num_updates) - before)
        if metrics is not None:
            metrics = {
                name: Reading(value, lambda: read.append(unbroken.counters.num_steps))
                for name, value in metrics.items()
            }
        return state, metrics

    updates.run = counting_run
    finished(unbroken)
    # All tests here share these functions, in whatever order they are run.
    compiled = _compilations(unbroken.agent.repeated_step)
    assert sizes == [4, 4, 4, 4, 4, 1] * (EPISODES - 1)  # of 21 in an episode
    # Metrics wait on the device until an episode is written down.
    assert set(read) == {STEPS * episode for episode in range(2, EPISODES + 1)}

    # In the middle of a group, half an episode after a checkpoint.
    broken = act_until(make_run(tmp_path / "broken", **changes), 2 * STEPS + 9)
    broken.loop()  # and no `finish`, as after a kill
    broken.log.close()
    resumed = make_run(tmp_path / "broken", **changes)
    assert resumed.counters.num_steps == 2 * STEPS
    assert_copied(resumed)
    finished(resumed)
    assert_copied(resumed)
    assert_same(resumed, unbroken, tmp_path, "broken", "unbroken")
    assert _compilations(resumed.agent.repeated_step) == compiled


def test_several_environments_resume_bit_for_bit_and_count_as_one(tmp_path):
    changes: dict[str, Any] = {"num_environments": 2, "updates_per_dispatch": 4}
    unbroken = finished(make_run(tmp_path / "unbroken", **changes))
    table = read_csv(tmp_path / "unbroken" / "train.csv")
    assert table["frame"].tolist() == [STEPS * n for n in (2, 2, 4, 4, 5)]
    assert table["episode"].tolist() == list(range(EPISODES))
    assert np.all(np.diff(table["seconds"]) >= 0)
    # One environment has learned since its first episode, two since their first ones.
    assert unbroken.state.num_updates == STEPS * (EPISODES - 2)

    broken = act_until(make_run(tmp_path / "broken", **changes), 2 * STEPS + 18)
    broken.loop()  # and no `finish`, as after a kill
    broken.log.close()
    assert broken.counters.num_steps == 2 * STEPS + 20
    resumed = make_run(tmp_path / "broken", **changes)
    assert resumed.counters.num_steps == 2 * STEPS
    finished(resumed)
    assert_same(resumed, unbroken, tmp_path, "broken", "unbroken")


@pytest.mark.parametrize("num_environments", [1, 2])
def test_a_run_that_is_stopped_again_and_again_equals_an_unbroken_one(
    tmp_path, num_environments
):
    # Every third step, so that a stop may fall between an episode's last update and its
    # end. Rewards are refreshed between two stops.
    changes: Any = {
        "method": "pdac",
        "num_environments": num_environments,
        "update_every_steps": 3,
        "updates_per_step": 2,
        "reward_refresh_steps": STEPS + 5,
        "eval_every_frames": 2 * STEPS,
    }

    def begin():
        return make_run(tmp_path / "broken", **changes)

    def stop_at(num_steps):
        run = finished(act_until(begin(), num_steps))
        assert run.player is not None
        assert run.player.open_episodes

    def stop_in_evaluation():
        run = begin()
        evaluation, taken = run.evaluator.environment, []
        step = evaluation.step

        def step_and_stop(action):
            taken.append(action)
            run.stop_asked |= len(taken) == 9
            return step(action)

        evaluation.step = step_and_stop
        assert finished(run).counters.owes_evaluation

    unbroken = finished(make_run(tmp_path / "unbroken", **changes))
    stop_at(10)
    stop_in_evaluation()
    stop_in_evaluation()  # in the second attempt
    killed = begin()
    killed.evaluate()  # its row is written, and no checkpoint
    killed.log.close()
    for num_steps in (59, 60, EPISODES * STEPS - 2):
        stop_at(num_steps)
    resumed = finished(begin())
    assert_same(resumed, unbroken, tmp_path, "broken", "unbroken")
    for number in unbroken.replay.episodes:
        ours, theirs = (run.replay.rewards(number) for run in (resumed, unbroken))
        np.testing.assert_array_equal(ours, theirs)


def test_refreshed_rewards_are_those_of_now(tmp_path):
    run = make_run(tmp_path, "pdac", reward_refresh_steps=1, update_every_steps=3)
    refreshed, refresh = [], run.updates.refresh_rewards

    def counting_refresh(state, require_finite):
        refreshed.append(run.counters.num_steps)
        refresh(state, require_finite)

    run.updates.refresh_rewards = counting_refresh
    finished(run)
    assert refreshed == [STEPS * number for number in range(1, EPISODES + 1)]
    assert len(run.replay.episodes) == 2
    for number in run.replay.episodes:
        stored = run.replay.episode(number)
        unknown = np.full(STEPS, np.nan, np.float32)
        episode = Episode(stored.frames, stored.actions, unknown, unknown)
        rewards = run.agent.rewards(
            run.state.rewarder, run.state.params, episode, run.experts
        )
        np.testing.assert_allclose(run.replay.rewards(number), rewards, rtol=1e-5)
        assert np.ptp(np.asarray(rewards)) > 0


def test_a_recomputed_reward_that_is_not_finite_stops_the_run(tmp_path):
    run = make_run(tmp_path, "pdac", reward_refresh_steps=1, update_every_steps=3)
    recomputed = np.full((8, STEPS), np.inf, np.float32)
    agent = dataclasses.replace(run.agent, refresh=lambda *_: recomputed)
    run.agent = run.updates._agent = agent
    with pytest.raises(TrainingDiverged, match="recomputed reward became infinite"):
        run.loop()
    run.close()


def assert_copied(run):
    replay, copied = run.replay, np.asarray(run.updates.frames().agent)
    for number in replay.episodes:
        frames = replay.episode(number).frames
        np.testing.assert_array_equal(copied[replay.slots(number)], frames)


class Reading:
    """A number that tells when it is read."""

    def __init__(self, value, tell):
        self._value, self._tell = value, tell

    def __float__(self):
        self._tell()
        return float(self._value)


def _compilations(step: Any) -> int:
    return step._cache_size()
