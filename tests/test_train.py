"""The training loop as a tape of events."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from tests.dummies import Dummies, acts_and_episodes


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
    # Rows are of the frame at which they are written, as checkpoints are: a resumed
    # run then drops exactly those that it will write again.
    assert [row["frame"] for row in dummies.rows] == [12, 12, 24, 24]
    assert [row["episode"] for row in dummies.rows] == [0, 1, 2, 3]
    assert np.all(np.diff([row["seconds"] for row in dummies.rows]) >= 0)


def test_several_updates_may_follow_a_step():
    once, thrice = (
        Dummies(update_every_steps=2, updates_per_step=n).loop().tape for n in (1, 3)
    )
    more = [[word] * (3 if word == "update" else 1) for word in once]
    assert once.count("update") > 1
    assert thrice == [word for words in more for word in words]


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


def actions_sent(dummies):
    """Returns the actions of a whole run."""
    sent, step = [], dummies.environments.step

    def noting_step(index, action):
        sent.append(action.item())
        step(index, action)

    dummies.environments.step = noting_step
    dummies.loop()
    return sent


def test_actions_are_uniform_at_first_and_of_each_step_its_own():
    dummies = Dummies(num_environments=2, exploration_steps=5, total_frames=24)
    sent = actions_sent(dummies)
    assert len(sent) == 12
    # One policy is asked for both environments, though the first still explores.
    assert acts_and_episodes(dummies.tape)[0] == "act 2 12"
    uniform = sent[:5]
    assert len(set(uniform)) == 5
    assert np.all(np.abs(uniform) <= 1)
    assert not any(sent[5:])
    # Whoever plays the step.
    assert actions_sent(Dummies(exploration_steps=5))[:5] == uniform


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


def test_rewards_that_change_before_a_refresh_is_due_are_refreshed_then():
    dummies = Dummies(reward_refresh_steps=4, total_frames=24)
    counters = dummies.run.counters
    dummies.rewarder.rewards_changed = lambda _: np.bool_(counters.num_steps in (3, 9))
    dummies.loop()
    ends = [word for word in dummies.tape if word.startswith(("store", "refresh"))]
    # At step 6 those of step 3, at step 12 those of step 9.
    assert [k for k, word in enumerate(ends) if word == "refresh"] == [2, 5]
    assert not counters.rewards_are_stale


def test_rewards_that_never_change_are_not_refreshed():
    assert "refresh" not in Dummies(reward_refresh_steps=1).loop().tape
