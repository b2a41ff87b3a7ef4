"""The replay against a plain list of episodes, and against numbers worked by hand."""

import collections

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.replay.replay import Replay, memory_bytes

DISCOUNT_FACTOR = 0.5
SIZES = {
    "capacity_steps": 12,
    "episode_steps": 4,
    "observation_shape": (2, 3, 3),
    "observation_dtype": np.uint8,
    "action_dim": 2,
    "frame_stack": 3,
    "num_steps": 3,
    "discount_factor": DISCOUNT_FACTOR,
}


def make_replay(*episodes: dict, **changes) -> Replay:
    replay = Replay(**(SIZES | changes))
    for episode in episodes:
        replay.add_episode(**episode)
    return replay


def make_episode(num_steps: int, seed: int, shape=(2, 3, 3)) -> dict:
    """Random contents: a frame of 18 random bytes is met only once."""
    rng = np.random.default_rng(seed)
    if len(shape) == 3:
        frames = rng.integers(0, 256, (num_steps + 1, *shape), dtype=np.uint8)
    else:
        frames = rng.normal(size=(num_steps + 1, *shape)).astype(np.float32)
    return {
        "frames": frames,
        "actions": rng.normal(size=(num_steps, 2)).astype(np.float32),
        "rewards": rng.normal(size=num_steps).astype(np.float32),
        "discounts": rng.choice([0.0, 0.5, 1.0], size=num_steps).astype(np.float32),
    }


EPISODES = [make_episode(4, seed) for seed in range(5)]


def stack_at(frames: np.ndarray, step: int, frame_stack: int) -> np.ndarray:
    """The definition: frames step-2, step-1, step, clipped at the first."""
    chosen = [frames[max(step - age, 0)] for age in reversed(range(frame_stack))]
    return np.concatenate(chosen, axis=-1)


def windows_of(episodes, frame_stack=3, num_steps=3) -> dict:
    """Lists every n-step transition of plain episodes, by the bytes of its ends."""
    windows = {}
    for episode in episodes:
        length = len(episode["rewards"])
        for start in range(length - num_steps + 1):
            reward, discount = 0.0, 1.0
            for step in range(start, start + num_steps):
                reward += discount * float(episode["rewards"][step])
                discount *= DISCOUNT_FACTOR * float(episode["discounts"][step])
            ends = (start, start + num_steps)
            stacks = [stack_at(episode["frames"], t, frame_stack) for t in ends]
            key = tuple(stack.tobytes() for stack in stacks)
            windows[key] = (episode["actions"][start], reward, discount)
    return windows


def ends_of(batch) -> list[tuple[bytes, ...]]:
    """Returns the bytes by which `windows_of` knows the transitions of a batch."""
    ends = zip(batch.observation, batch.next_observation, strict=True)
    return [tuple(stack.tobytes() for stack in pair) for pair in ends]


def assert_same_transitions(one, other) -> None:
    for name in ("observation", "action", "reward", "discount", "next_observation"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@settings(deadline=None, max_examples=60)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=14),
    capacity_steps=st.integers(9, 30),
    episode_steps=st.integers(1, 9),
    frame_stack=st.integers(1, 4),
    num_steps=st.integers(1, 5),
    pixels=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_samples_are_windows_of_the_newest_episodes(
    lengths, capacity_steps, episode_steps, frame_stack, num_steps, pixels, seed
):
    shape = (2, 3, 3) if pixels else (5,)
    frame_stack = frame_stack if pixels else 1
    replay = make_replay(
        capacity_steps=capacity_steps,
        episode_steps=episode_steps,
        observation_shape=shape,
        observation_dtype=np.uint8 if pixels else np.float32,
        frame_stack=frame_stack,
        num_steps=num_steps,
    )
    most_frames = capacity_steps + -(-capacity_steps // episode_steps)
    plain = []
    rng = np.random.default_rng(seed)
    for number, length in enumerate(lengths):
        episode = make_episode(length, seed + number, shape)
        replay.add_episode(**episode)
        plain.append(episode)
        while (
            sum(len(kept["rewards"]) for kept in plain) > capacity_steps
            or sum(len(kept["frames"]) for kept in plain) > most_frames
        ):
            plain.pop(0)
        assert replay.num_steps_stored == sum(len(kept["rewards"]) for kept in plain)
        assert replay.num_episodes_added == number + 1
        assert replay.episodes == list(range(number + 1 - len(plain), number + 1))
        assert replay.oldest_episode == replay.episodes[0]
        for index, kept in enumerate(plain, start=replay.oldest_episode):
            stored = replay.episode(index)._asdict()
            for name, array in kept.items():
                np.testing.assert_array_equal(stored[name], array)
        windows = windows_of(plain, frame_stack, num_steps)
        assert replay.can_sample() == bool(windows)
        if not windows:
            continue
        batch = replay.sample(rng, 8)
        for item, ends in enumerate(ends_of(batch)):
            action, reward, discount = windows[ends]
            np.testing.assert_array_equal(batch.action[item], action)
            np.testing.assert_allclose(batch.reward[item], reward, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(batch.discount[item], discount, rtol=1e-6)


def test_a_whole_window_by_hand():
    # Environment discounts 1, 1/2, 1; gamma 1/2: weights 1, 1/2, 1/8.
    replay = make_replay(
        observation_shape=(1,), observation_dtype=np.float32, frame_stack=1
    )
    replay.add_episode(
        frames=np.array([[0], [1], [2], [3]], np.float32),
        actions=[[10, 0], [11, 0], [12, 0]],
        rewards=[1, 10, 100],
        discounts=[1, 0.5, 1],
    )
    batch = replay.sample(np.random.default_rng(0), 2, windows=True)
    assert batch.window is not None
    np.testing.assert_array_equal(batch.window.observation, [[[0], [1], [2]]] * 2)
    np.testing.assert_array_equal(batch.window.action[..., 0], [[10, 11, 12]] * 2)
    np.testing.assert_array_equal(batch.window.weight, [[1, 0.5, 0.125]] * 2)
    np.testing.assert_array_equal(batch.reward, [1 + 5 + 12.5] * 2)
    np.testing.assert_array_equal(batch.discount, [1 / 16] * 2)
    np.testing.assert_array_equal(batch.next_observation, [[3]] * 2)
    # The same sample without windows is the same batch.
    plain = replay.sample(np.random.default_rng(0), 2)
    assert plain.window is None
    assert_same_transitions(plain, batch)


def test_successors_are_one_step_later_in_the_same_episode():
    # Frame t of episode e holds 10 e + t; the ring has lost the first two.
    times = 10 * np.arange(5)[:, None] + np.arange(5)
    frames = times.astype(np.uint8).reshape(5, 5, 1, 1, 1)
    episodes = [EPISODES[index] | {"frames": frames[index]} for index in range(5)]
    replay = make_replay(*episodes, observation_shape=(1, 1, 1))
    batch = replay.sample(np.random.default_rng(0), 50, windows=True, successors=True)
    assert batch.successor is not None
    stacks, successors = batch.observation[:, 0, 0], batch.successor[:, 0, 0]
    np.testing.assert_array_equal(successors[:, -1], stacks[:, -1] + 1)
    # Their older frames are the observation's newer ones, also at an episode's start.
    np.testing.assert_array_equal(successors[:, :-1], stacks[:, 1:])
    assert len(np.unique(stacks[:, -1])) == 6  # two windows in each of three episodes
    assert batch.window is not None
    np.testing.assert_array_equal(batch.window.observation[:, 1], batch.successor)
    # They change nothing else of what is sampled.
    plain = replay.sample(np.random.default_rng(0), 50, windows=True)
    assert plain.successor is None
    assert plain.window is not None
    for ours, theirs in zip(plain.window, batch.window):
        np.testing.assert_array_equal(ours, theirs)
    assert_same_transitions(plain, batch)


def test_every_window_is_sampled_equally_often():
    episodes = [make_episode(length, seed) for seed, length in enumerate((3, 2, 7))]
    replay = make_replay(*episodes)
    windows = windows_of(episodes)
    assert len(windows) == 6  # 1 + 0 + 5
    batch = replay.sample(np.random.default_rng(0), 6000)
    counts = collections.Counter(ends_of(batch))
    assert set(counts) == set(windows)
    # 1000 expected, standard deviation sqrt(6000 * 1/6 * 5/6) = 29: five of them.
    assert max(abs(count - 1000) for count in counts.values()) < 145


def test_a_time_limit_keeps_the_bootstrap():
    episode = make_episode(2, seed=0) | {"discounts": np.ones(2)}
    replay = make_replay(episode, num_steps=2)
    batch = replay.sample(np.random.default_rng(0), 1)
    np.testing.assert_array_equal(batch.discount, [DISCOUNT_FACTOR**2])


def test_stacks_repeat_the_first_frame_and_are_contiguous():
    replay = make_replay(num_steps=1)
    frames = np.stack([np.full((2, 3, 3), value, np.uint8) for value in (7, 8)])
    replay.add_episode(frames=frames, actions=[[0, 0]], rewards=[0], discounts=[1])
    batch = replay.sample(np.random.default_rng(0), 1)
    assert batch.observation.shape == (1, 2, 3, 9)
    assert batch.observation.dtype == np.uint8
    assert batch.next_observation.flags.c_contiguous
    assert batch.observation[0, 0, 0].tolist() == [7] * 9
    assert batch.next_observation[0, 0, 0].tolist() == [7] * 6 + [8] * 3


def test_large_batches_go_to_threads_and_stay_the_same():
    shape = (64, 64, 3)
    episodes = [make_episode(10, seed, shape) for seed in range(3)]
    sizes = {"capacity_steps": 40, "episode_steps": 10, "observation_shape": shape}
    replay = make_replay(*episodes, **sizes)
    # 2 * 200 stacks of 36864 bytes are 14.7 MB; 2 * 5 of them are made in one piece.
    large = replay.sample(np.random.default_rng(3), 200)
    assert set(ends_of(large)) <= set(windows_of(episodes))


def test_the_same_generator_draws_the_same_batch():
    replay = make_replay(*EPISODES)
    # Refilled from its stored episodes, the ring begins in another slot.
    refilled = make_replay()
    refilled.clear(replay.oldest_episode)
    for index in replay.episodes:
        refilled.add_episode(**replay.episode(index)._asdict())
    batches = [r.sample(np.random.default_rng(1), 32) for r in (replay, refilled)]
    for first, second in zip(*batches, strict=True):
        np.testing.assert_array_equal(first, second)
    assert refilled.num_episodes_added == replay.num_episodes_added == 5


def test_stored_arrays_are_copies():
    episode = make_episode(4, seed=0)
    original = episode["frames"].copy()
    replay = make_replay(episode)
    episode["frames"][:] = 0
    replay.episode(0).frames[:] = 1
    np.testing.assert_array_equal(replay.episode(0).frames, original)


def test_the_paper_s_replay_stays_under_3300_megabytes():
    size = memory_bytes(
        capacity_steps=150_000,
        episode_steps=500,
        observation_shape=(84, 84, 3),
        observation_dtype=np.uint8,
        action_dim=6,
    )
    # 150000 steps in 300 episodes: 150300 frames, each with 6 + 2 floats.
    assert size == 150_300 * (84 * 84 * 3 + 8 * 4)
    assert size < 3.3e9


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": np.zeros((5, 2, 3, 3))}, "frames.dtype = float64: expected uint8"),
        ({"frames": np.zeros((5, 2, 2, 3), "u1")}, r"frames.shape = \(5, 2, 2, 3\)"),
        ({"frames": np.zeros((1, 2, 3, 3), np.uint8)}, "expected at least two frames"),
        ({"actions": np.zeros((5, 2))}, r"actions.shape = \(5, 2\): expected \(4, 2\)"),
        ({"actions": np.full((4, 2), "a")}, "actions.dtype"),
        ({"rewards": np.zeros((4, 1))}, r"rewards.shape = \(4, 1\): expected \(4,\)"),
        ({"rewards": [0, 0, np.nan, 0]}, r"rewards\[2\] = nan: expected finite"),
        ({"rewards": [0, 1e300, 0, 0]}, r"rewards\[1\] = inf: expected finite"),
        ({"discounts": [1, 1, 1, 1.5]}, r"discounts\[3\] = 1.5: expected in \[0, 1\]"),
        ({"discounts": [1, np.nan, 1, 1]}, r"discounts\[1\] = nan"),
        (make_episode(13, seed=0), "episode length = 13: expected at most 12"),
    ],
)
def test_a_bad_episode_is_refused_whole(changes, message):
    replay = make_replay(make_episode(12, seed=0))
    with pytest.raises(ValueError, match=message):
        replay.add_episode(**(make_episode(4, seed=1) | changes))
    assert replay.num_episodes_added == 1
    assert replay.num_steps_stored == 12


def test_sampling_needs_a_window():
    replay = make_replay(make_episode(2, seed=0))
    assert not replay.can_sample()
    with pytest.raises(ValueError, match="an episode of at least 3 steps"):
        replay.sample(np.random.default_rng(0), 1)


def test_only_stored_episodes_can_be_read():
    replay = make_replay(*EPISODES[:4])
    for index in (0, 4, -1):
        with pytest.raises(IndexError, match="holds 3 of the episodes 1 to 3"):
            replay.episode(index)


def test_a_skipped_number_leaves_a_gap():
    replay = make_replay()  # of 12 steps
    replay.clear(5)
    replay.add_episode(**make_episode(4, 5))
    replay.skip_episode()
    for seed in (7, 8):
        replay.add_episode(**make_episode(4, seed))
    assert replay.episodes == [5, 7, 8]
    assert replay.num_episodes_added == 9
    with pytest.raises(IndexError, match="episode 6 is not stored"):
        replay.episode(6)
    for index in replay.episodes:
        frames = make_episode(4, index)["frames"]
        np.testing.assert_array_equal(replay.episode(index).frames, frames)
    windows = windows_of([make_episode(4, seed) for seed in (5, 7, 8)])
    assert set(ends_of(replay.sample(np.random.default_rng(0), 200))) == set(windows)
    replay.add_episode(**make_episode(8, 9))
    assert replay.episodes == [8, 9]


def test_replaced_rewards():
    replay = make_replay(*EPISODES[:2])
    replay.replace_rewards(1, [1, 2, 3, 4])
    np.testing.assert_array_equal(replay.rewards(1), [1, 2, 3, 4])
    total = make_episode(4, 0)["rewards"].sum(dtype=np.float64) + 10.0
    assert replay.mean_reward() == pytest.approx(total / 8)
    for wrong in ([1, 2], [1, 2, 3, np.nan]):
        with pytest.raises(ValueError, match="rewards"):
            replay.replace_rewards(1, wrong)
    np.testing.assert_array_equal(replay.rewards(1), [1, 2, 3, 4])
    assert np.isnan(make_replay().mean_reward())
