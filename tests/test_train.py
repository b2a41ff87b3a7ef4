"""The loop as a tape of events, and what it does about numbers that are not."""

import dataclasses
import types
from typing import Any

import dm_env
import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil import train
from jaxil.environments.interaction import Decision, Moment, interact, join
from jaxil.environments.pool import EnvironmentsFailed

_EPISODE_STEPS = 3


class DummyEnvironment:
    """Episodes of three decisions; frame t of episode e holds the number 10 e + t."""

    episode_steps = _EPISODE_STEPS

    def reset(self, episode):
        self.episode, self.time = episode, 0
        return dm_env.restart(self.single_observation())

    def step(self, action):
        del action
        self.time += 1
        if self.time == _EPISODE_STEPS:
            return dm_env.truncation(float(self.time), self.single_observation(), 1.0)
        return dm_env.transition(float(self.time), self.single_observation(), 1.0)

    def single_observation(self):
        return np.array([10.0 * self.episode + self.time], np.float32)


class InProcessPool:
    """Several environments that work when they are waited for."""

    def __init__(self, environments, tape=None):
        self.size = len(environments)
        self.environments = environments
        self.tape = [] if tape is None else tape
        self.orders = {}
        self.lost = set()  # the places of those to be lost at the next occasion

    def reset(self, place, episode):
        self.orders[place] = lambda: self.environments[place].reset(episode)

    def step(self, place, action):
        self.tape.append(f"step {place}")
        self.orders[place] = lambda: self.environments[place].step(action)

    def receive(self, place):
        timestep = self.orders.pop(place)()
        if place in self.lost:
            self.lost.remove(place)
            return None
        return Moment(
            observation=timestep.observation,
            frame=self.environments[place].single_observation(),
            task_reward=timestep.reward or 0.0,
            discount=1.0 if timestep.discount is None else timestep.discount,
            is_last=timestep.last(),
        )

    def close(self):
        pass


class TapeRun(train.Run):
    """A run whose work is to say what it would have done."""

    def __init__(self, config, first_episode=0):
        self.config = config
        self.environment: Any = DummyEnvironment()
        self.counters = train.Counters(num_episodes=first_episode)
        self.stopwatch = train.Stopwatch()
        self.decisions: dict[int, list[Decision]] = {}
        self.tape: list[str] = []
        self.pool: Any = None
        if config.num_environments > 1:
            dummies = [DummyEnvironment() for _ in range(config.num_environments)]
            self.pool = InProcessPool(dummies, self.tape)
        self.state: Any = None
        self.updates: Any = types.SimpleNamespace(run=lambda state: (state, None))
        self.returns = {}
        self.stop_asked = False
        self.progress = types.SimpleNamespace(update=lambda *_: None)
        self.replay = types.SimpleNamespace(
            can_sample=lambda: self.counters.num_episodes > first_episode
        )

    def act(self, observation):
        self.tape.append(f"act {observation[0]:.0f}")
        return np.zeros(1)

    def act_together(self, observations):
        numbers = [f"{observation[0]:.0f}" for observation in observations]
        self.tape.append(f"act {' '.join(numbers)}")
        return np.zeros((len(observations), 1))

    def update(self):
        self.tape.append("update")

    def finish_episode(self, number, *, later=()):
        assert list(later) == sorted(later)
        episode = join(self.decisions.pop(number))
        self.tape.append(f"store {episode.frames[:, 0].astype(int).tolist()}")
        self.counters.num_episodes += 1

    def evaluate(self):
        self.tape.append("evaluate")
        self.counters.last_eval_step = self.counters.num_steps

    def save(self):
        self.tape.append("save")
        self.counters.last_checkpoint_step = self.counters.num_steps


def _config(**changes):
    config = jaxil_config.default_config()
    config.update(
        action_repeat=2,
        seed_frames=8,
        update_every_steps=2,
        total_frames=18,
        eval_every_frames=12,
        checkpoint_every_frames=6,
    )
    config.update(changes)
    return config


def test_events_come_in_the_order_of_the_method():
    run = TapeRun(_config())
    run.loop()
    # Decisions cost two frames, episodes have three of them. Updates: on every second
    # decision from frame 8 on, after the first stored episode. Evaluations: at the
    # episode end where 12 frames have gone by since the last, and at the budget's end.
    assert run.tape == [
        *("act 0", "act 1", "act 2", "store [0, 1, 2, 3]", "save"),
        *("act 10", "update", "act 11", "act 12", "update"),
        *("store [10, 11, 12, 13]", "evaluate", "save"),
        *("act 20", "act 21", "update", "act 22"),
        *("store [20, 21, 22, 23]", "evaluate", "save"),
    ]


def test_an_update_is_started_before_the_step_that_it_shares_its_time_with():
    run = TapeRun(_config())
    step = run.environment.step

    def taped_step(action):
        run.tape.append("step")
        return step(action)

    run.environment.step = taped_step
    run.loop()
    acted = run.tape.index("act 10")
    assert run.tape[acted : acted + 3] == ["act 10", "update", "step"]


def test_several_environments_take_turns_with_the_learner():
    run = TapeRun(_config(num_environments=2, seed_frames=2, total_frames=24))
    run.loop()
    # The same updates as of one environment, those of both decisions together, between
    # sending actions and waiting. Both episodes end in one round, to be looked at once.
    sent = ("step 0", "step 1")
    assert run.tape == [
        *("act 0 10", *sent, "act 1 11", *sent, "act 2 12", *sent),
        *("store [0, 1, 2, 3]", "store [10, 11, 12, 13]", "evaluate", "save"),
        *("act 20 30", *sent, "update", "act 21 31", *sent, "update"),
        *("act 22 32", *sent, "update"),
        *("store [20, 21, 22, 23]", "store [30, 31, 32, 33]", "evaluate", "save"),
    ]
    assert run.counters.num_steps == 12


@pytest.mark.parametrize(("size", "every"), [(2, 1), (2, 2), (3, 2), (4, 5)])
def test_updates_and_episodes_are_as_many_as_with_one_environment(size, every):
    changes = {"seed_frames": 2, "update_every_steps": every, "total_frames": 42}
    runs = [TapeRun(_config(**changes, num_environments=n)) for n in (1, size)]
    for run in runs:
        run.replay.can_sample = lambda: True
        run.loop()
    one, several = runs
    assert several.counters == dataclasses.replace(
        one.counters,
        last_eval_step=several.counters.last_eval_step,
        last_checkpoint_step=several.counters.last_checkpoint_step,
    )
    assert one.counters.num_episodes == 7
    assert several.tape.count("update") == one.tape.count("update") == 21 // every
    stored = [[word for word in run.tape if "store" in word] for run in runs]
    assert stored[0] == stored[1]
    # The rounds of the last episodes are smaller, and the last look comes after all.
    assert several.tape[-2:] == ["evaluate", "save"]
    assert several.counters.last_eval_step == several.counters.num_steps


def test_a_lost_episode_is_played_again_and_its_frames_stay_counted():
    run = TapeRun(_config(num_environments=2, total_frames=12, eval_every_frames=999))
    receive, waits = run.pool.receive, []

    def receive_and_lose(place):
        waits.append(place)
        if len(waits) == 6:  # two resets, two decisions of each; this one is lost
            run.pool.lost.add(place)
        return receive(place)

    run.pool.receive = receive_and_lose
    run.loop()
    assert [word for word in run.tape if word[:3] in ("act", "sto")] == [
        *("act 0 10", "act 1 11", "act 2 10"),
        *("store [0, 1, 2, 3]", "act 11", "act 12", "store [10, 11, 12, 13]"),
    ]
    # Evaluated once, though the budget was used up when the first episode ended.
    assert run.tape[-3:] == ["store [10, 11, 12, 13]", "evaluate", "save"]
    assert run.tape.count("evaluate") == 1
    assert run.counters.num_steps == 8


def test_a_stop_is_heeded_after_the_round():
    run = TapeRun(_config(num_environments=2, total_frames=60))
    act = run.act_together

    def act_and_stop(observations):
        run.stop_asked = observations[0] == 20
        return act(observations)

    run.act_together = act_and_stop
    run.loop()
    assert run.tape[-4:] == ["act 20 30", "step 0", "step 1", "update"]
    assert run.counters.num_steps == 8


def test_the_end_of_environments_names_the_way_on(monkeypatch, tmp_path):
    closed = []

    class Failing(train.Run):
        def __init__(self, *arguments):
            self.progress: Any = types.SimpleNamespace(message=print)
            self.checkpoints: Any = types.SimpleNamespace(newest=lambda: 4000)

        def loop(self, *, whole_episodes=True):
            raise EnvironmentsFailed("environment 1 was killed by SIGKILL.")

        def close(self):
            closed.append(True)

    monkeypatch.setattr(train, "Run", Failing)
    config = _config(method="drqv2")
    with pytest.raises(EnvironmentsFailed, match="SIGKILL") as caught:
        train.train(config, tmp_path)
    assert "that of frame 4000. The same command goes on" in str(caught.value)
    assert closed


def test_nothing_is_due_by_coincidence_only():
    # 10 frames never meet an episode end (multiples of 6); a modulo would never fire.
    run = TapeRun(_config(eval_every_frames=10, total_frames=36))
    run.loop()
    assert run.tape.count("evaluate") == 3  # at frames 12, 24 and 36


def test_no_update_before_the_seed_frames_or_without_experience():
    run = TapeRun(_config(seed_frames=1, total_frames=6))
    run.loop()
    assert "update" not in run.tape  # the first episode enters at its end only


def test_the_budget_ends_with_an_episode_and_an_evaluation():
    # After a Ctrl-C, episodes no longer end at multiples of the budget.
    run = TapeRun(_config(total_frames=8, eval_every_frames=100))
    run.loop()
    assert run.counters.num_steps == 6
    assert run.tape[-3:] == ["store [10, 11, 12, 13]", "evaluate", "save"]
    run.loop()
    assert run.counters.num_steps == 6  # nothing is left to do
    run = TapeRun(_config(total_frames=8))
    run.loop(whole_episodes=False)
    assert run.counters.num_steps == 4


def test_a_stop_is_heeded_at_once():
    run = TapeRun(_config())
    act, run_act = [], run.act

    def act_and_stop(observation):
        act.append(observation)
        run.stop_asked = len(act) == 4
        return run_act(observation)

    run.act = act_and_stop
    run.loop()
    assert run.counters.num_steps == 4


def test_a_resumed_run_starts_at_its_own_episode():
    run = TapeRun(_config(total_frames=6), first_episode=7)
    run.loop()
    assert run.tape[0] == "act 70"


def test_an_episode_must_be_whole():
    decisions = []
    for decision in interact(
        DummyEnvironment(), lambda _: np.zeros(1), first_episode=0
    ):
        decisions.append(decision)
        if decision.is_last:
            break
    assert join(decisions).task_rewards.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="not whole"):
        join(decisions[1:])
    with pytest.raises(ValueError, match="not whole"):
        join(decisions[:-1])


@pytest.mark.parametrize(("newest", "said"), [(None, "none"), (4000, "frame 4000")])
def test_numbers_that_are_not_finite_stop_the_run(newest, said):
    run = TapeRun(_config())
    fake: Any = run
    fake.checkpoints = types.SimpleNamespace(newest=lambda: newest)
    fake.state = types.SimpleNamespace(num_updates=np.int32(12))
    run.require_finite({"critic/loss": 1.0})
    with pytest.raises(train.TrainingDiverged, match=said) as caught:
        run.require_finite({"critic/loss": float("nan"), "actor/loss": 1.0})
    assert "critic/loss" in str(caught.value)
    assert "update 12" in str(caught.value)
    assert "actor/loss" not in str(caught.value)
