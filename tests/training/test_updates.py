"""Whole runs whose frames lie on the device, or whose updates go there in groups.

The environment is a drawing that moves with the actions, so that nothing is simulated.
Most of the time goes into compiling: 35 s of a core.
"""

import functools
import types
from typing import Any

import dm_env
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dm_env import specs

from jaxil import config as jaxil_config
from jaxil import train
from jaxil.demonstrations.loading import Demonstrations
from jaxil.files.tables import read_csv
from jaxil.training import assembly
from tests.test_train import InProcessPool

SIDE, STEPS, EPISODES = 12, 21, 5
REAL_MAKE_AGENT = assembly.make_agent
CLOCKS = ("seconds", "frames_per_second", "reward_seconds")


class Drawing:
    """Episodes of 21 decisions, in which a square goes where the actions lead it."""

    episode_steps = STEPS

    def reset(self, episode):
        self._rng = np.random.default_rng(episode)
        self._time, self._place = 0, np.full(2, SIDE / 2)
        self._frames = [self.single_observation()] * 3
        return dm_env.restart(self._observation())

    def step(self, action):
        self._time += 1
        self._place = np.clip(self._place + 2 * np.asarray(action), 1, SIDE - 2)
        self._frames = [*self._frames[1:], self.single_observation()]
        end = dm_env.truncation if self._time == STEPS else dm_env.transition
        return end(float(self._place[0]), self._observation(), 1.0)

    def single_observation(self):
        row, column = self._place.astype(int)
        noise = np.random.default_rng([self._time, row, column])
        frame = noise.integers(0, 100, (SIDE, SIDE, 3), dtype=np.uint8)
        frame[row - 1 : row + 2, column - 1 : column + 2] = 250
        return frame

    def _observation(self):
        return np.concatenate(self._frames, axis=-1)

    def action_spec(self):
        return specs.BoundedArray((2,), np.float32, -1.0, 1.0)

    def observation_spec(self):
        return specs.Array((SIDE, SIDE, 9), np.uint8)


def make_config(method, **changes):
    config = jaxil_config.default_config(method, "walker_walk")
    config.update(
        image_size=SIDE,
        action_repeat=1,
        update_every_steps=1,
        seed_frames=STEPS,
        exploration_steps=10,
        total_frames=STEPS * EPISODES,
        replay_size_steps=2 * STEPS + 5,  # the ring runs over its end
        batch_size=8,
        num_steps=3,
        hidden_dim=16,
        feature_dim=8,
        shift_padding=1,
        eval_every_frames=10**9,
        num_eval_episodes=1,
        checkpoint_every_frames=2 * STEPS,
        video_every_evals=0,
    )
    config.encoder.channels = (4, 4)
    config.encoder.kernel_sizes, config.encoder.strides = (3, 3), (2, 1)
    config.discriminator.batch_size = config.cloning.batch_size = 4
    config.discriminator.hidden_dim = 16
    config.update(changes)
    return config


def make_demonstrations():
    drawing, rng = Drawing(), np.random.default_rng(9)
    frames, actions = [], rng.uniform(-1, 1, (2, STEPS, 2)).astype(np.float32)
    for episode in range(2):
        drawing.reset(episode)
        frames.append([drawing.single_observation()])
        for action in actions[episode]:
            drawing.step(action)
            frames[-1].append(drawing.single_observation())
    lengths = np.array([STEPS + 1, STEPS - 3])
    metadata = {"returns": [], "task": "walker_walk"}
    return Demonstrations(np.array(frames), lengths, actions, None, metadata)


@functools.cache
def make_agent(method):
    """Compiles once for all runs, and draws the first state once."""
    environment: Any = Drawing()
    agent = REAL_MAKE_AGENT(make_config(method), environment, make_demonstrations())
    start = agent.init_state()
    return agent._replace(init_state=lambda: jax.tree.map(jnp.copy, start))


@pytest.fixture(autouse=True)
def _nothing_is_simulated(monkeypatch):
    monkeypatch.setattr(assembly, "environment_with_seed", lambda *_: Drawing())
    monkeypatch.setattr(assembly, "make_agent", lambda c, *_: make_agent(c.method))
    monkeypatch.setattr(assembly, "training_pool", lambda c, *_: make_pool(c))
    closeness = types.SimpleNamespace(relative_distance=lambda episodes: None)
    monkeypatch.setattr(train, "Closeness", lambda *_: closeness)


def make_pool(config):
    drawings = [Drawing() for _ in range(config.num_environments)]
    return InProcessPool(drawings) if len(drawings) > 1 else None


def make_run(folder, method="dac", **changes):
    folder.mkdir(exist_ok=True)
    return train.Run(
        make_config(method, **changes), folder, make_demonstrations(), print
    )


def finished(run):
    run.loop()
    run.finish()
    return run


def assert_same(run, other, tmp_path):
    """Compares the tables, clocks left out, and what was learned."""
    ours, theirs = (read_csv(tmp_path / f / "train.csv") for f in (run, other))
    assert len(ours["frame"]) == EPISODES
    for column in set(theirs) - set(CLOCKS):
        np.testing.assert_array_equal(ours[column], theirs[column], column)


def assert_same_params(run, other):
    leaves = [jax.tree.leaves(r.state.params) for r in (run, other)]
    for ours, theirs in zip(*leaves, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_frames_on_the_device_change_no_number(tmp_path):
    # DAC draws all that there is to draw: windows, experts, and their actions.
    here = finished(make_run(tmp_path / "here"))
    there = finished(make_run(tmp_path / "there", replay_on_device=True))
    assert there.state.num_updates == STEPS * (EPISODES - 1) == 84
    assert_same("there", "here", tmp_path)
    assert_same_params(there, here)
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

    broken = make_run(tmp_path / "broken", **changes)
    act = broken.act

    def act_until_killed(observation):
        # In the middle of a group, half an episode after a checkpoint.
        broken.stop_asked = broken.counters.num_steps == 2 * STEPS + 9
        return act(observation)

    broken.act = act_until_killed
    broken.loop()  # and no `finish`, as after a kill
    broken.outputs.close()
    resumed = make_run(tmp_path / "broken", **changes)
    assert resumed.counters.num_steps == 2 * STEPS
    assert_mirrored(resumed)
    finished(resumed)
    assert_mirrored(resumed)
    assert_same("broken", "unbroken", tmp_path)
    assert_same_params(resumed, unbroken)
    assert _compilations(resumed.agent.repeated_step) == compiled


def test_several_environments_resume_bit_for_bit_and_count_as_one(tmp_path):
    changes: dict[str, Any] = {"num_environments": 2, "updates_per_dispatch": 4}
    unbroken = finished(make_run(tmp_path / "unbroken", **changes))
    table = read_csv(tmp_path / "unbroken" / "train.csv")
    assert table["frame"].tolist() == [STEPS * n for n in range(1, EPISODES + 1)]
    assert table["episode"].tolist() == list(range(EPISODES))
    assert np.all(np.diff(table["seconds"]) >= 0)
    # One environment has learned since its first episode, two since their first ones.
    assert unbroken.state.num_updates == STEPS * (EPISODES - 2)

    broken = make_run(tmp_path / "broken", **changes)
    act = broken.act_together

    def act_until_killed(observations):
        broken.stop_asked = broken.counters.num_steps == 2 * STEPS + 18
        return act(observations)

    broken.act_together = act_until_killed
    broken.loop()  # and no `finish`, as after a kill
    broken.outputs.close()
    assert broken.counters.num_steps == 2 * STEPS + 20
    resumed = make_run(tmp_path / "broken", **changes)
    assert resumed.counters.num_steps == 2 * STEPS
    finished(resumed)
    assert_same("broken", "unbroken", tmp_path)
    assert_same_params(resumed, unbroken)
    assert _compilations(resumed.agent.explore_together) == 1


def test_actions_of_several_are_those_of_each_with_noise_of_its_own_step(tmp_path):
    run = make_run(tmp_path, num_environments=3, exploration_steps=10)
    drawings = [Drawing() for _ in range(3)]
    seen = np.stack([d.reset(n).observation for n, d in enumerate(drawings)])
    for first in (4, 9, 20):  # uniform, both, the policy's
        run.counters.num_steps = first
        together = run.act_together(seen)
        for place, observation in enumerate(seen):
            run.counters.num_steps = first + place
            alone = run.act(observation)
            np.testing.assert_allclose(together[place], alone, rtol=0, atol=1e-5)
    assert len(np.unique(together)) == together.size
    # Fewer than there may be, at a run's end, act alike.
    run.counters.num_steps = 20
    np.testing.assert_array_equal(run.act_together(seen[:2]), together[:2])
    run.outputs.close()


def assert_mirrored(run):
    replay = run.replay
    for number in range(replay.oldest_episode, replay.num_episodes_added):
        slots, frames = replay.slots(number), replay.episode(number).frames
        np.testing.assert_array_equal(run.updates._mirror.frames[slots], frames)


class Reading:
    """A number that tells when it is read."""

    def __init__(self, value, tell):
        self._value, self._tell = value, tell

    def __float__(self):
        self._tell()
        return float(self._value)


def _compilations(step: Any) -> int:
    return step._cache_size()


def test_settings_of_speed_are_checked_at_the_door():
    config = jaxil_config.default_config("pdac", "walker_walk")
    config.update(updates_per_dispatch=0, compute_dtype="float16", num_environments=65)
    faults = jaxil_config.problems(config, ("walker_walk",))
    assert len(faults) == 3
    assert "compute_dtype='float16' is unknown; choose one of: float32" in faults[0]
    assert "updates_per_dispatch=0 must lie in [1, 1000]" in faults[1]
    assert "num_environments=65 must lie in [1, 64]" in faults[2]
