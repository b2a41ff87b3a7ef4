"""The loop as a tape of events, and what it does about numbers that are not."""

import types
from typing import Any

import dm_env
import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil import train
from jaxil.host.interaction import Decision, interact, join

_EPISODE_STEPS = 3


class DummyEnvironment:
    """Episodes of three decisions; frame t of episode e holds the number 10 e + t."""

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


class TapeRun(train.Run):
    """A run whose work is to say what it would have done."""

    def __init__(self, config, first_episode=0):
        self.config = config
        self.environment = DummyEnvironment()
        self.counters = train.Counters(num_episodes=first_episode)
        self.stopwatch = train.Stopwatch()
        self.decisions: list[Decision] = []
        self.tape: list[str] = []
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

    def update(self):
        self.tape.append("update")

    def finish_episode(self):
        episode = join(self.decisions)
        self.decisions = []
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
