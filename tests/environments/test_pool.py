"""Environments in processes: the same episodes, whatever happens to a process.

Spawning takes most of the time: some twenty processes, a second each on an idle core.
"""

import contextlib
import functools
import os
import pathlib
import signal
import subprocess
import sys
import time

import dm_env
import numpy as np
import pytest

from jaxil.environments import pool as pool_module
from jaxil.environments.player import InProcess, Moment, Player
from jaxil.environments.pool import Pool
from jaxil.environments.tasks import make_environment
from jaxil.errors import EnvironmentsFailed
from tests.processes import is_alive, wait_until_gone

ROOT = pathlib.Path(__file__).parent.parent.parent
STEPS = 4


class Counting:
    """Episodes of four steps; what is seen at time t of episode e is (10 e + t, pid).

    Its single frame is the first of both. A negative action ends it in its own way.
    """

    def reset(self, episode):
        self.episode, self.time = episode, 0
        return dm_env.restart(self._observation())

    def step(self, action):
        if action[0] == -1.0:
            raise ArithmeticError("the simulation exploded")
        if action[0] == -2.0:
            os._exit(3)
        if action[0] == -3.0:
            sys.exit("gone")
        self.time += 1
        end = dm_env.truncation if self.time == STEPS else dm_env.transition
        return end(float(action[0]), self._observation(), 0.5)

    def single_observation(self):
        return self._observation()[:1]

    def close(self):
        pass

    def _observation(self):
        return np.array([10 * self.episode + self.time, os.getpid()], np.float32)


def without_jax(make):
    """Makes an environment where jax was never imported, and nowhere else."""
    environment = make()
    if "jax" in sys.modules:
        raise ImportError("jax was imported")
    return environment


def play(
    environments, num_episodes, act=lambda seen: seen[:, :1] % 10, each_round=None
):
    """Plays whole episodes; returns them by number."""
    player, whole = Player(environments, first_episode=0), {}
    for number in range(100):
        player.begin(lambda: player.next_episode < num_episodes)
        if not player.is_playing:
            return whole
        steps = {n: len(actions) for n, actions in player.open_episodes.items()}
        player.step(act(player.observations))
        ended = player.observe()
        whole |= zip(sorted(set(steps) - set(player.open_episodes)), ended, strict=True)
        if each_round is not None:
            each_round(number, steps)
    raise AssertionError("it goes on and on")


def counting_pool(size, say=print):
    return Pool(Counting, size, say=say)


def assert_counted(episodes):
    for number, episode in episodes.items():
        times = np.arange(STEPS + 1)
        np.testing.assert_array_equal(episode.frames[:, 0], 10 * number + times)
        np.testing.assert_array_equal(episode.actions[:, 0], times[:-1])
        np.testing.assert_array_equal(episode.rewards, times[:-1])
        np.testing.assert_array_equal(episode.discounts, 0.5)


def test_episodes_are_those_of_a_single_environment():
    make = functools.partial(
        make_environment,
        "cartpole_swingup",
        seed=3,
        action_repeat=200,
        image_size=16,
        render_quality="fast",
    )

    def act(seen):  # anything that depends on all that is seen
        return np.cos(np.float64(seen).reshape(len(seen), -1).sum(axis=1))[:, None]

    single = make()
    pool = Pool(functools.partial(without_jax, make), 2, say=print)
    with contextlib.closing(pool):
        found = play(pool, 3, act)
    expected = play(InProcess(single), 3, act)
    single.close()
    assert sorted(found) == sorted(expected) == [0, 1, 2]
    for number, episode in expected.items():
        for ours, theirs in zip(found[number], episode, strict=True):
            np.testing.assert_array_equal(ours, theirs)
            assert ours.dtype == theirs.dtype
    assert np.ptp(found[0].frames) > 0
    assert found[0].frames.shape[0] == 6


def test_several_processes_play_and_none_is_left():
    pool = counting_pool(2)
    pids = pool.pids
    seen_pids = set()

    def act(seen):
        seen_pids.update(seen[:, 1])
        return seen[:, :1] % 10

    assert_counted(play(pool, 5, act))
    # Pids of seven digits are still exact in float32.
    assert seen_pids == {float(pid) for pid in pids}
    pool.close()
    assert not any(map(is_alive, pids))
    pool.close()  # again does nothing


@pytest.mark.parametrize(
    ("sent", "said"),
    [(signal.SIGKILL, "was killed by SIGKILL"), (signal.SIGSTOP, "not answer for 3 s")],
)
def test_a_lost_process_is_replaced_and_its_episode_played_again(
    sent, said, monkeypatch
):
    monkeypatch.setattr(pool_module, "_STEP_SECONDS", 3.0)
    lines, rounds = [], []
    pool = counting_pool(2, lines.append)
    first_pids = pool.pids

    def lose_one(number, steps):
        rounds.append(steps)
        if number == 1:
            os.kill(first_pids[0], sent)

    with contextlib.closing(pool):
        assert_counted(play(pool, 4, each_round=lose_one))
        assert pool.pids[1] == first_pids[1]
        assert pool.pids[0] != first_pids[0]
        assert not is_alive(first_pids[0])
    steps = [{0: 0, 1: 0}, {0: 1, 1: 1}, {0: 2, 1: 2}, {0: 0, 1: 3}]
    assert rounds[:4] == steps
    (line,) = lines
    assert f"environment 0 {'did ' * (sent == signal.SIGSTOP)}{said}" in line
    assert "restarts episode 0" in line


class Large(Counting):
    """What is seen does not fit into a pipe at once."""

    def _observation(self):
        return np.zeros(10**6, np.float32)


def test_a_process_killed_in_mid_answer_is_replaced():
    lines = []
    pool = Pool(Large, 1, say=lines.append)
    with contextlib.closing(pool):
        pool.reset(0, 0)
        assert isinstance(pool.receive(0), Moment)
        (pid,) = pool.pids
        pool.step(0, np.ones(1))
        time.sleep(1.0)  # by then it waits for its answer to be taken
        os.kill(pid, signal.SIGKILL)
        assert pool.receive(0) is None
        pool.reset(0, 0)
    assert "was killed by SIGKILL" in lines[0]


def test_an_exit_of_the_environment_is_its_error():
    pool = counting_pool(1)
    with contextlib.closing(pool), pytest.raises(EnvironmentsFailed) as caught:
        play(pool, 1, lambda seen: np.where(seen[:, :1] == 1, -3.0, 1.0))
    assert "environment 0 raised an error: SystemExit: gone" in str(caught.value)


def test_an_error_of_the_environment_says_what_and_where():
    pool = counting_pool(2)
    pids = pool.pids
    with contextlib.closing(pool), pytest.raises(EnvironmentsFailed) as caught:
        play(pool, 2, lambda seen: np.where(seen[:, :1] == 11, -1.0, 1.0))
    said = "environment 1 raised an error: ArithmeticError: the simulation exploded"
    assert f"{said} (test_pool.py, line " in str(caught.value)
    assert not any(map(is_alive, pids))


def test_processes_that_never_get_far_are_given_up():
    lines = []
    pool = counting_pool(1, lines.append)
    with contextlib.closing(pool), pytest.raises(EnvironmentsFailed) as caught:
        play(pool, 9, lambda seen: np.where(seen[:, :1] == 11, -2.0, 1.0))
    assert "environment 0 ended with status 3" in str(caught.value)
    assert "4 workers in a row died in mid-episode" in str(caught.value)
    assert len(lines) == 3


_PARENT = """
import sys, time
from tests.environments.test_pool import counting_pool, play
if __name__ == "__main__":
    pool = counting_pool(2)
    play(pool, 2)
    print(*pool.pids, flush=True)
    if "raise" in sys.argv:
        raise RuntimeError
    time.sleep(1000)
"""


@pytest.mark.parametrize("way", ["kill", "raise"])
def test_processes_end_with_their_parent(way, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    parent = subprocess.Popen(
        [sys.executable, str(script), way],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert parent.stdout is not None
    pids = [int(word) for word in parent.stdout.readline().split()]
    assert len(pids) == 2
    if way == "kill":
        assert all(map(is_alive, pids))
        # Ctrl-C goes to all processes of a terminal; the parent alone decides.
        for pid in pids:
            os.kill(pid, signal.SIGINT)
        time.sleep(0.2)
        assert all(map(is_alive, pids))
        parent.kill()
    parent.communicate(timeout=60)
    wait_until_gone(pids)
