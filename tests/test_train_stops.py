"""What the loop does about stops, lost episodes and numbers that are not finite."""

from typing import Any

import numpy as np
import pytest

from jaxil import train
from jaxil.errors import EnvironmentsFailed, TrainingDiverged
from tests.dummies import Dummies, acts_and_episodes, make_config


def test_a_lost_episode_is_played_again_and_its_frames_stay_counted():
    changes: Any = {"num_environments": 2, "total_frames": 12, "eval_every_frames": 999}
    # Two resets, two steps of each: this one is lost.
    dummies = Dummies(lost=[5], **changes).loop()
    assert acts_and_episodes(dummies.tape) == [
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
    assert acts_and_episodes(dummies.tape) == ["act 0 10"]


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


def test_a_stop_in_the_last_round_is_a_finished_run():
    dummies = Dummies()
    evaluate = dummies.run.evaluator.evaluate

    def then_stop(*args, **kwargs):
        result = evaluate(*args, **kwargs)
        dummies.run.stop_asked = kwargs["is_last"]
        return result

    dummies.run.evaluator.evaluate = then_stop
    dummies.loop()
    assert dummies.run.stop_asked
    assert dummies.run.is_finished


def test_a_method_that_does_not_play_writes_the_row_of_a_stopped_evaluation_once():
    dummies = Dummies(eval_every_frames=8, total_frames=16)
    run, updates = dummies.run, []
    run.player = None
    metrics = {"actor/loss": np.float32(0.5)}
    run.updates.run = lambda state: (state, metrics)
    run.log.updates = lambda when, metrics: updates.append((when.frame, metrics))
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
        *("evaluation stopped", "save", "evaluate", "save", "last evaluation", "save")
    ]


def test_the_end_of_environments_names_the_way_on(monkeypatch, tmp_path):
    dummies = Dummies()

    def fail(index):
        raise EnvironmentsFailed(f"environment {index} was killed by SIGKILL.")

    dummies.environments.receive = fail
    monkeypatch.setattr(train.Run, "make", lambda *_: dummies.run)
    with pytest.raises(EnvironmentsFailed, match="SIGKILL") as caught:
        train.train(make_config(method="drqv2"), tmp_path)
    assert "that of frame 4000. Rerun the same command" in str(caught.value)
    assert dummies.tape == ["close"]


def test_a_resumed_run_starts_at_its_own_episode():
    assert Dummies(total_frames=6, first_episode=7).loop().tape[0] == "act 70"


def test_a_reward_that_is_not_finite_stops_the_run_before_it_is_stored():
    dummies = Dummies(reward=float("nan"))
    with pytest.raises(TrainingDiverged, match="imitation reward became"):
        dummies.loop()
    assert not dummies.num_stored


def test_a_task_is_not_blamed_on_the_imitation():
    def rewards(rewarder, params, episode, experts):
        del rewarder, params, experts
        episode.rewards[:] = np.nan
        return episode.rewards

    dummies = Dummies()
    dummies.run.agent.rewards = rewards
    with pytest.raises(TrainingDiverged, match="the task's reward became"):
        dummies.loop()


def test_an_action_that_is_not_finite_stops_the_run_before_the_task_gets_it():
    dummies = Dummies(exploration_steps=0)
    sample = dummies.run.agent.sample_action
    dummies.run.agent.sample_action = lambda *seen: sample(*seen) * np.nan
    with pytest.raises(TrainingDiverged, match="an action became infinite or NaN"):
        dummies.loop()
    assert not any(word.startswith("step") for word in dummies.tape)


@pytest.mark.parametrize(("newest", "said"), [(None, "none"), (4000, "frame 4000")])
def test_numbers_that_are_not_finite_stop_the_run(newest, said):
    dummies = Dummies(seed_frames=0)
    dummies.run.checkpoints.newest = lambda: newest
    metrics = {"critic/loss": np.float32("nan"), "actor/loss": np.float32(1.0)}
    dummies.run.updates.run = lambda state: (state, metrics)
    with pytest.raises(TrainingDiverged, match=said) as caught:
        dummies.loop()
    assert "critic/loss" in str(caught.value)
    assert "update 12" in str(caught.value)
    assert "actor/loss" not in str(caught.value)
    assert not dummies.rows
