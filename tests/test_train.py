"""The loop as a tape of events, and what it does about numbers that are not."""

import dataclasses
import types
from typing import Any

import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil import train
from jaxil.environments.evaluation import Evaluation
from jaxil.environments.player import Player
from jaxil.environments.pool import EnvironmentsFailed
from jaxil.training.evaluator import Result
from jaxil.training.parts import Counters
from jaxil.training.stopwatch import Stopwatch
from tests.environments.counting import Counting, InTurn

_EPISODE_STEPS = 3


class Dummies:
    """The parts of a run, which write down on one tape what they are asked to do."""

    def __init__(self, *, lost=(), first_episode=0, reward=0.0, **changes):
        self.tape: list[str] = []
        self.config = _config(**changes)
        self.environments = InTurn(
            [Counting(_EPISODE_STEPS) for _ in range(self.config.num_environments)],
            self.tape,
            lost,
        )
        self.run: Any = None  # set at the end; the parts ask it how far it has come
        self.num_stored = self.num_rewarded = 0
        self.reward_value = reward
        self.act = lambda: None  # happens at each agent step
        counters = Counters(num_episodes=first_episode)
        shape = types.SimpleNamespace(shape=(1,))
        self.state = types.SimpleNamespace(
            params=(None, None, None), rewarder=None, num_updates=np.int32(12)
        )
        self.state.replace = lambda rewarder: self.state
        self.rewarder = types.SimpleNamespace(
            summary=lambda _: {}, rewards_changed=None
        )
        self.run = train.Run(
            config=self.config,
            agent=self._named(
                sample_action=self._sample_action,
                observe=lambda rewarder, *_: rewarder,
                rewards=self._rewards,
                rewarder=self.rewarder,
                mean_image=None,
            ),
            state=self._named(**vars(self.state)),
            counters=counters,
            player=Player(self.environments, first_episode=first_episode),
            episode_steps=_EPISODE_STEPS,
            replay=self._named(
                can_sample=lambda: self.num_stored > 0,
                add_episode=self._store,
                mean_reward=lambda: 0.0,
            ),
            updates=self._named(
                is_pending=False,
                collect=self._collect,
                run=lambda state: (state, None),
                episode_added=lambda: None,
                refresh_rewards=lambda _: self.tape.append("refresh"),
            ),
            experts=None,
            evaluator=self._named(
                environment=types.SimpleNamespace(action_spec=lambda: shape),
                evaluate=self._evaluate,
            ),
            checkpoints=self._named(
                save=lambda **_: self.tape.append("save"), newest=lambda: 4000
            ),
            log=self._named(
                episode=lambda **row: self.rows.append(row),
                evaluation=lambda *_, **__: "a line",
                close=lambda: None,
            ),
            progress=self._named(
                update=lambda *_: None, message=lambda _: None, close=lambda: None
            ),
            stopwatch=Stopwatch(),
        )
        self.rows: list[dict] = []

    @staticmethod
    def _named(**members) -> Any:
        return types.SimpleNamespace(**members)

    def _sample_action(self, encoder, actor, observations, key, steps):
        del encoder, actor, key
        assert len(observations) == len(steps) == self.config.num_environments
        assert steps[0] == self.run.counters.num_steps
        seen = (f"{number:.0f}" for number in observations[:, 0])
        self.tape.append(f"act {' '.join(seen)}")
        self.act()
        return np.zeros((len(observations), 1), np.float32)

    def _collect(self, rng):
        del rng
        self.tape.append("update")
        return True

    def _rewards(self, rewarder, params, episode, experts):
        del rewarder, params, experts
        self.num_rewarded += 1
        return np.full(len(episode.actions), self.reward_value, np.float32)

    def _store(self, frames, actions, rewards, discounts):
        assert len(frames) == len(actions) + 1 == len(rewards) + 1 == len(discounts) + 1
        self.num_stored += 1
        self.tape.append(f"store {frames[:, 0].astype(int).tolist()}")

    def _evaluate(self, state, *, number, is_last, stop_asked):
        del state
        assert number == self.run.counters.num_evals
        if stop_asked():
            self.tape.append("evaluation stopped")
            return None
        self.tape.append("last evaluation" if is_last else "evaluate")
        return Result(
            evaluation=Evaluation([], np.zeros(0), []),
            distance=None,
            sides=[],
            filmed={},
        )

    def loop(self, **kwargs):
        self.run.loop(**kwargs)
        return self


def _config(**changes):
    config = jaxil_config.default_config("pdac", "walker_walk")
    settings = {
        "action_repeat": 2,
        "seed_frames": 6,
        "exploration_steps": 0,
        "update_every_steps": 2,
        "total_frames": 18,
        "eval_every_frames": 12,
        "checkpoint_every_frames": 6,
        "reward_refresh_steps": 0,
    }
    config.update(settings | changes)
    return config


def test_events_come_in_the_order_of_the_method():
    dummies = Dummies().loop()
    # Steps take two frames, episodes three steps. Updates: at every second step that
    # begins at frame 6 or later, after the first stored episode, and before the
    # environment's step, which takes place meanwhile. Evaluations: at the episode's end
    # where 12 frames have gone by since the last, and at the budget's end.
    step = "step 0"
    assert dummies.tape == [
        *("act 0", step, "act 1", step, "act 2", step, "store [0, 1, 2, 3]", "save"),
        *("act 10", step, "update", "act 11", step, "act 12", step, "update"),
        *("store [10, 11, 12, 13]", "evaluate", "save"),
        *("act 20", step, "act 21", step, "update", "act 22", step),
        *("store [20, 21, 22, 23]", "last evaluation", "save"),
    ]
    rows = dummies.rows
    assert [row["frame"] for row in rows] == [6, 12, 18]
    assert [row["episode"] for row in rows] == [0, 1, 2]
    assert [row["task_return"] for row in rows] == [6.0] * 3


@pytest.mark.parametrize("size", [1, 2])
def test_updates_start_between_sending_an_action_and_waiting_for_its_outcome(size):
    changes: Any = {"update_every_steps": 1, "total_frames": 24}
    dummies = Dummies(num_environments=size, **changes)
    receive = dummies.environments.receive

    def taped_receive(index):
        dummies.tape.append(f"receive {index}")
        return receive(index)

    dummies.environments.receive = taped_receive
    tape = dummies.loop().tape
    begin = tape.index("update")
    indices = range(size)
    assert tape[begin - size : begin + 2 * size] == [
        *(f"step {index}" for index in indices),
        *("update" for _ in indices),
        *(f"receive {index}" for index in indices),
    ]


def test_the_first_update_comes_after_the_seed_frames():
    # Eight frames have been observed before the fifth step.
    tape = Dummies(seed_frames=8, update_every_steps=1).loop().tape
    assert tape[: tape.index("update")].count("step 0") == 5
    # Without experience there is none: the first episode enters at its end.
    assert "update" not in Dummies(seed_frames=2, total_frames=6).loop().tape


def test_several_environments_take_turns_with_the_learner():
    dummies = Dummies(num_environments=2, seed_frames=2, total_frames=24).loop()
    # The updates of both steps together. Both episodes end at once.
    sent = ("step 0", "step 1")
    assert dummies.tape == [
        *("act 0 10", *sent, "act 1 11", *sent, "act 2 12", *sent),
        *("store [0, 1, 2, 3]", "store [10, 11, 12, 13]", "evaluate", "save"),
        *("act 20 30", *sent, "update", "act 21 31", *sent, "update"),
        *("act 22 32", *sent, "update"),
        *("store [20, 21, 22, 23]", "store [30, 31, 32, 33]"),
        *("last evaluation", "save"),
    ]
    # In the table they stand as if played one after the other.
    assert [row["frame"] for row in dummies.rows] == [6, 12, 18, 24]
    assert np.all(np.diff([row["seconds"] for row in dummies.rows]) > 0)


@pytest.mark.parametrize(("size", "every"), [(2, 1), (2, 2), (3, 2), (4, 5)])
def test_updates_and_episodes_are_as_many_as_with_one_environment(size, every):
    changes = {"seed_frames": 0, "update_every_steps": every, "total_frames": 42}
    both = [Dummies(**changes, num_environments=n) for n in (1, size)]
    for dummies in both:
        dummies.num_stored = 1
        dummies.loop()
    one, several = both
    ours, theirs = (dataclasses.asdict(each.run.counters) for each in both)
    for name in ("seconds", "num_evals", "last_eval_step", "last_checkpoint_step"):
        del ours[name], theirs[name]
    assert ours == theirs
    assert one.run.counters.num_episodes == 7
    assert several.tape.count("update") == one.tape.count("update") == 21 // every
    stored = [[word for word in each.tape if "store" in word] for each in both]
    assert stored[0] == stored[1]
    # Fewer play at the end, and the last evaluation comes after all of them.
    assert several.tape[-2:] == ["last evaluation", "save"]


def _acts_and_episodes(tape):
    return [word for word in tape if word[:3] in ("act", "sto")]


def test_a_lost_episode_is_played_again_and_its_frames_stay_counted():
    changes: Any = {"num_environments": 2, "total_frames": 12, "eval_every_frames": 999}
    # Two resets, two steps of each: this one is lost.
    dummies = Dummies(lost=[5], **changes).loop()
    assert _acts_and_episodes(dummies.tape) == [
        *("act 0 10", "act 1 11", "act 2 10"),
        *("store [0, 1, 2, 3]", "act 11 0", "act 12 0", "store [10, 11, 12, 13]"),
    ]
    # Evaluated once, though the budget was used up when the first episode ended.
    assert dummies.tape[-3:] == ["store [10, 11, 12, 13]", "last evaluation", "save"]
    assert dummies.tape.count("last evaluation") == 1
    assert dummies.run.counters.num_steps == 8


def test_an_episode_lost_at_the_budgets_end_is_played_before_the_last_evaluation():
    changes: Any = {"num_environments": 2, "total_frames": 12, "eval_every_frames": 999}
    tape = Dummies(lost=[7], **changes).loop().tape  # when the other one ends
    assert tape.count("last evaluation") == 1
    assert tape[-3:] == ["store [10, 11, 12, 13]", "last evaluation", "save"]


@pytest.mark.parametrize("size", [1, 2])
def test_a_stop_is_heeded_after_the_step(size):
    dummies = Dummies(num_environments=size, total_frames=60)

    def stop():
        if dummies.run.counters.num_steps == 4 * size:
            assert dummies.run.ask_to_stop("Ctrl-C")
            assert not dummies.run.ask_to_stop("Ctrl-C")  # it was asked before

    dummies.act = stop
    dummies.loop()
    assert dummies.run.counters.num_steps == 5 * size
    dummies.run.finish()
    assert dummies.tape[-1] == "save"  # in the middle of an episode
    # An episode that was due to begin did so, as in a run that goes on.
    assert len(dummies.run.player.open_episodes) == size


def test_a_stop_while_episodes_begin_starts_them_all():
    dummies = Dummies(num_environments=2, total_frames=60)
    reset = dummies.environments.reset

    def reset_and_stop(index, episode):
        dummies.run.stop_asked = True
        reset(index, episode)

    dummies.environments.reset = reset_and_stop
    dummies.loop()
    assert _acts_and_episodes(dummies.tape) == ["act 0 10"]


def test_updates_that_were_collected_run_before_a_stop():
    dummies = Dummies(update_every_steps=1, num_environments=1, total_frames=60)
    pending: list[None] = []
    updates = dummies.run.updates

    def collect(_):
        pending.append(None)
        updates.is_pending = len(pending) < 2
        return len(pending) == 2

    def run(state):
        dummies.tape.append(f"run {len(pending)}")
        pending.clear()
        updates.is_pending = False
        return state, None

    def stop():
        dummies.run.stop_asked |= dummies.run.counters.num_steps == 3

    updates.collect, updates.run, dummies.act = collect, run, stop
    dummies.loop()
    # One update was due at the step of the stop: the next step made it two.
    assert dummies.run.counters.num_steps == 5
    assert [word for word in dummies.tape if "run" in word][-2:] == ["run 2", "run 0"]


def test_a_stopped_evaluation_is_made_up_for_at_once_and_saved():
    dummies = Dummies()
    evaluate = dummies.run.evaluator.evaluate

    def stopped_evaluate(*args, **kwargs):
        dummies.run.stop_asked = not kwargs["number"]
        return evaluate(*args, **kwargs)

    dummies.run.evaluator.evaluate = stopped_evaluate
    dummies.loop()
    assert dummies.tape[-2:] == ["evaluation stopped", "save"]
    assert dummies.run.counters.owes_evaluation
    del dummies.tape[:]
    dummies.run.evaluator.evaluate = evaluate
    dummies.run.stop_asked = False  # as in the process that resumes
    dummies.loop()
    assert dummies.tape[:3] == ["evaluate", "save", "act 20"]
    assert dummies.tape.count("evaluate") == 1
    assert not dummies.run.counters.owes_evaluation


def test_a_method_that_does_not_play_writes_the_row_of_a_stopped_evaluation_once():
    dummies = Dummies(eval_every_frames=8, total_frames=16)
    run, updates = dummies.run, []
    run.player = None
    metrics = {"actor/loss": np.float32(0.5)}
    run.updates.run = lambda state: (state, metrics)
    run.log.updates = lambda **row: updates.append((row["frame"], row["metrics"]))
    evaluate = run.evaluator.evaluate

    def stopped(*arguments, **named):
        run.stop_asked = True
        return evaluate(*arguments, **named)

    run.evaluator.evaluate = stopped
    dummies.loop()
    run.evaluator.evaluate, run.stop_asked = evaluate, False
    dummies.loop()
    assert updates == [(frame, {"actor/loss": 0.5}) for frame in (8, 16)]
    words = [word for word in dummies.tape if word != "update"]
    assert words == [
        "evaluation stopped",
        "save",
        "evaluate",
        "save",
        "last evaluation",
        "save",
    ]


def test_the_end_of_environments_names_the_way_on(monkeypatch, tmp_path):
    dummies = Dummies()

    def fail(index):
        raise EnvironmentsFailed(f"environment {index} was killed by SIGKILL.")

    dummies.environments.receive = fail
    parts = {
        field.name: getattr(dummies.run, field.name)
        for field in dataclasses.fields(train.Parts)
    }
    monkeypatch.setattr(train, "make_parts", lambda *_: parts)
    with pytest.raises(EnvironmentsFailed, match="SIGKILL") as caught:
        train.train(_config(method="drqv2"), tmp_path)
    assert "that of frame 4000. Rerun the same command" in str(caught.value)
    assert dummies.tape == ["close"]


def test_nothing_is_due_by_coincidence_only():
    # 10 frames never meet an episode end (multiples of 6); a modulo would never fire.
    tape = Dummies(eval_every_frames=10, total_frames=36).loop().tape
    assert tape.count("evaluate") == 2  # at frames 12 and 24
    assert tape.count("last evaluation") == 1


def test_the_budget_ends_with_an_episode_and_an_evaluation():
    # After a Ctrl-C, episodes no longer end at multiples of the budget.
    dummies = Dummies(total_frames=8, eval_every_frames=100).loop()
    assert dummies.run.counters.num_steps == 6
    assert dummies.tape[-3:] == ["store [10, 11, 12, 13]", "last evaluation", "save"]
    before = list(dummies.tape)
    assert dummies.loop().tape == before  # nothing is left to do
    dummies = Dummies(total_frames=8).loop(whole_episodes=False)
    assert dummies.run.counters.num_steps == 4


def test_a_resumed_run_starts_at_its_own_episode():
    assert Dummies(total_frames=6, first_episode=7).loop().tape[0] == "act 70"


def test_actions_are_uniform_at_first_and_of_each_step_its_own():
    dummies = Dummies(num_environments=2, exploration_steps=5, total_frames=24)
    sent: dict[int, float] = {}
    step = dummies.environments.step

    def noting_step(index, action):
        sent[len(sent)] = action.item()
        step(index, action)

    dummies.environments.step = noting_step
    dummies.loop()
    # One policy is asked for both environments, though the first still explores.
    assert _acts_and_episodes(dummies.tape)[0] == "act 2 12"
    uniform = [sent[number] for number in range(5)]
    assert len(set(uniform)) == 5
    assert np.all(np.abs(uniform) <= 1)
    assert not any(sent[number] for number in range(5, 12))
    one = Dummies(exploration_steps=5)
    step_one, alone = one.environments.step, []

    def noting_one(index, action):
        alone.append(action.item())
        step_one(index, action)

    one.environments.step = noting_one
    one.loop()
    assert alone[:5] == uniform  # whoever plays the step


@pytest.mark.parametrize(
    ("every", "changes_at", "expected"),
    [
        (0, True, []),
        (1, True, [3, 6, 9, 12]),
        (4, True, [6, 12]),
        (4, False, []),
        (7, True, [9]),
    ],
)
def test_rewards_are_refreshed_at_ends_of_episodes(every, changes_at, expected):
    dummies = Dummies(reward_refresh_steps=every, total_frames=24)
    dummies.rewarder.rewards_changed = lambda _: np.bool_(changes_at)
    dummies.loop()
    steps, refreshed = 0, []
    for word in dummies.tape:
        steps += word.startswith("step")
        if word == "refresh":
            refreshed.append(steps)
    assert refreshed == expected
    if expected:  # after the episode has entered the replay
        assert dummies.tape[dummies.tape.index("refresh") - 1].startswith("store")


def test_rewards_that_never_change_are_not_refreshed():
    assert "refresh" not in Dummies(reward_refresh_steps=1).loop().tape


def test_a_reward_that_is_not_finite_stops_the_run_before_it_is_stored():
    dummies = Dummies(reward=float("nan"))
    with pytest.raises(train.TrainingDiverged, match="imitation reward became"):
        dummies.loop()
    assert not dummies.num_stored


@pytest.mark.parametrize(("newest", "said"), [(None, "none"), (4000, "frame 4000")])
def test_numbers_that_are_not_finite_stop_the_run(newest, said):
    dummies = Dummies(seed_frames=0)
    dummies.run.checkpoints.newest = lambda: newest
    metrics = {"critic/loss": np.float32("nan"), "actor/loss": np.float32(1.0)}
    dummies.run.updates.run = lambda state: (state, metrics)
    with pytest.raises(train.TrainingDiverged, match=said) as caught:
        dummies.loop()
    assert "critic/loss" in str(caught.value)
    assert "update 12" in str(caught.value)
    assert "actor/loss" not in str(caught.value)
    assert not dummies.rows
