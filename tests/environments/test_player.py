"""The player against a plain loop: the same episodes, in whatever order they come."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.environments.player import InProcess, Player
from jaxil.errors import EnvironmentsFailed
from tests.environments.counting import Counting, InTurn

_LENGTHS = st.lists(st.integers(1, 5), min_size=6, max_size=6)


def policy(seen):
    """Returns actions that tell what was seen."""
    return np.sin(seen).astype(np.float32)


def plain(lengths, number):
    """Plays one episode in a loop that anyone can check."""
    environment = Counting(lambda episode: lengths[episode])
    timestep = environment.reset(number)
    frames, actions, rewards, discounts = [timestep.observation], [], [], []
    while not timestep.last():
        actions.append(policy(timestep.observation))
        timestep = environment.step(actions[-1])
        frames.append(timestep.observation)
        rewards.append(timestep.reward)
        discounts.append(timestep.discount)
    return [np.stack(frames), np.stack(actions), np.array(rewards), np.array(discounts)]


def environments(lengths, size, lost=()):
    each = [Counting(lambda episode: lengths[episode]) for _ in range(size)]
    return InTurn(each, lost=lost)


def play(player, count, rounds=1000):
    """Plays all episodes, or some rounds; returns those that ended."""
    finished = []
    for _ in range(rounds):
        player.begin(lambda: player.next_episode < count)
        if not player.is_playing:
            break
        player.step(policy(player.observations))
        finished += player.observe()
    return finished


def assert_plain(finished, lengths):
    """Compares episodes, in any order, with those of the plain loop."""
    by_number = {int(episode.frames[0, 0]) // 10: episode for episode in finished}
    assert len(by_number) == len(finished)
    for number, episode in by_number.items():
        for ours, theirs in zip(episode, plain(lengths, number), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    return sorted(by_number)


@settings(deadline=None)
@given(
    lengths=_LENGTHS,
    size=st.integers(1, 4),
    lost=st.sets(st.integers(0, 40), max_size=6),
)
def test_every_episode_is_that_of_a_plain_loop_whatever_is_lost(lengths, size, lost):
    player = Player(environments(lengths, size, lost), first_episode=0)
    assert assert_plain(play(player, 6), lengths) == [0, 1, 2, 3, 4, 5]
    assert not player.open_episodes


@settings(deadline=None)
@given(
    lengths=_LENGTHS,
    size=st.integers(1, 3),
    rounds=st.integers(0, 20),
    lost=st.sets(st.integers(0, 20), max_size=3),
)
def test_open_episodes_go_on_in_another_player(lengths, size, rounds, lost):
    first = Player(environments(lengths, size, lost), first_episode=0)
    finished = play(first, 6, rounds)
    kept = {number: actions.tolist() for number, actions in first.open_episodes.items()}
    second = Player(
        environments(lengths, size),
        first_episode=len(finished) + len(kept),
        open_episodes={number: np.array(actions) for number, actions in kept.items()},
    )
    # Asked before anything has begun, as a second stop might.
    assert {n: a.tolist() for n, a in second.open_episodes.items()} == kept
    assert second.is_playing == bool(kept)
    finished += play(second, 6)
    assert assert_plain(finished, lengths) == [0, 1, 2, 3, 4, 5]


def test_a_player_goes_on_in_the_very_next_round_with_the_same_choices():
    # Episode 0 has ended and frees an environment; episode 1 still needs two steps.
    lengths = [2, 4, 4]
    unbroken = Player(environments(lengths, 2), first_episode=0)
    play(unbroken, 2, rounds=2)
    resumed = Player(
        environments(lengths, 2), first_episode=2, open_episodes=unbroken.open_episodes
    )
    left = []
    for player in (unbroken, resumed):
        player.begin(lambda player=player: left.append(player.steps_left(4)) or True)
    assert left == [2, 2]
    np.testing.assert_array_equal(resumed.observations, unbroken.observations)
    assert unbroken.observations.tolist() == [[12.0], [20.0]]


def test_open_episodes_are_repeated_action_by_action():
    made = environments([4], 1)
    taken, step = [], made.step

    def taped_step(index, action):
        taken.append(action.tolist())
        step(index, action)

    made.step = taped_step
    actions = np.array([[0.25], [-0.5]], np.float32)
    player = Player(made, first_episode=4, open_episodes={0: actions})
    player.begin(lambda: True)
    assert taken == actions.tolist()
    assert player.observations.tolist() == [[2.0]]


def test_an_open_episode_whose_environment_is_lost_meanwhile_starts_again():
    actions = np.zeros((3, 1), np.float32)
    made = environments([5], 1, lost=[2])  # while the second action is repeated
    player = Player(made, first_episode=1, open_episodes={0: actions})
    assert assert_plain(play(player, 1), [5]) == [0]
    assert made.received == 3 + 6


def test_an_open_episode_that_now_ends_sooner_starts_again():
    """As in a task that cannot be seeded: its end must not be run through."""
    actions = np.zeros((3, 1), np.float32)
    player = Player(environments([2], 1), first_episode=1, open_episodes={0: actions})
    assert assert_plain(play(player, 1), [2]) == [0]


def test_what_is_seen_and_what_ends_come_by_number_not_by_environment():
    # Environment 0 is free first, and plays episode 2 beside episode 1.
    player = Player(environments([1, 3, 2], 2), first_episode=0)
    seen = []
    ended = []
    for _ in range(3):
        player.begin(lambda: player.next_episode < 3)
        seen.append(player.observations[:, 0].tolist())
        player.step(policy(player.observations))
        ended.append([int(e.frames[0, 0]) // 10 for e in player.observe()])
    assert seen == [[0, 10], [11, 20], [12, 21]]
    assert ended == [[0], [], [1, 2]]


def test_nothing_begins_that_is_not_wanted():
    player = Player(environments([3], 2), first_episode=0)
    assert not player.begin(lambda: False)
    assert not player.is_playing
    assert player.steps_left(3) == 0


def test_one_environment_of_this_process_steps_when_it_is_waited_for():
    environment = Counting(2)
    single = InProcess(environment)
    single.reset(0, 7)
    assert not hasattr(environment, "episode")
    moment = single.receive(0)
    assert (moment.task_reward, moment.discount, moment.is_last) == (0.0, 1.0, False)
    assert moment.frame == moment.observation == 70
    single.step(0, np.zeros(1))
    assert environment.time == 0
    assert single.receive(0).discount == pytest.approx(0.5)
    single.step(0, np.zeros(1))
    assert single.receive(0).is_last


def test_an_error_of_the_task_in_a_step_says_what_and_where():
    environment = Counting(3)

    def step(action):
        raise FloatingPointError("the arm broke off")

    environment.step = step
    player = Player(InProcess(environment), first_episode=0)
    assert player.begin(lambda: True)
    player.step(np.zeros((1, 1)))
    with pytest.raises(EnvironmentsFailed) as caught:
        player.observe()
    said = str(caught.value)
    assert "raised an error in a step: FloatingPointError: the arm broke" in said
    assert "(test_player.py, line " in said
