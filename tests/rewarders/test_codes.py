"""The code of frames: what it is fitted to, for how long, and how it sees a stack."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.maths import stacking
from jaxil.maths.types import ExpertEpisodes
from jaxil.rewarders import codes
from jaxil.training.lengths import pad_episode
from tests.tiny_agent import make_episode, random_frames

STACK, COMPONENTS, SIDE = 3, 4, 12
observe, encode_frames = jax.jit(codes.observe), jax.jit(codes.encode_frames)


def empty():
    shape = (SIDE, SIDE, 3 * STACK)
    return codes.init_code(shape, num_components=COMPONENTS, frame_stack=STACK)


def experts(seed=0, lengths=(9, 5)):
    frames = random_frames(seed, 18).reshape(2, 9, SIDE, SIDE, 3).copy()
    for episode, length in zip(frames, lengths):
        episode[length:] = episode[length - 1]
    return ExpertEpisodes(frames, np.asarray(lengths), np.zeros((2, 0, 0)))


def flat(frames):
    return frames.reshape(-1, SIDE * SIDE * 3) / 255.0


def test_the_mean_is_of_demonstrations_each_weighing_the_same():
    code = observe(empty(), make_episode(random_frames(1, 20)), experts())
    frames = experts().frames
    expected = (flat(frames[0]).mean(0) + flat(frames[1, :5]).mean(0)) / 2
    # 512 samples of 9 or 5 frames are not quite the same number of each.
    np.testing.assert_allclose(code.mean, expected, atol=2e-3)


def test_padding_of_short_demonstrations_is_not_read():
    padded = experts()
    padded.frames[1, 5:] = 255
    plays = make_episode(random_frames(1, 20))
    first, second = (observe(empty(), plays, each) for each in (experts(), padded))
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_nor_is_padding_of_short_episodes():
    play = random_frames(1, 20)
    expected = observe(empty(), make_episode(play), experts())
    padded = pad_episode(make_episode(play), 23)
    padded.frames[20:] = 255
    code = observe(empty(), padded, experts())
    assert code.num_rows == expected.num_rows
    np.testing.assert_allclose(
        np.abs(code.sketch), np.abs(expected.sketch), rtol=1e-3, atol=1e-3
    )


def test_components_are_those_of_demonstrations_and_play():
    play = [random_frames(seed, 20) for seed in (1, 2)]
    code = empty()
    for frames in play:
        code = observe(code, make_episode(frames), experts(lengths=(8, 8)))
    demonstrations = flat(experts(lengths=(8, 8)).frames[:, :8]).reshape(-1, 432)
    rows = np.concatenate([np.repeat(demonstrations, 64, axis=0), flat(play[0])])
    rows = np.concatenate([rows, flat(play[1])]) - np.asarray(code.mean)
    _, lengths, directions = np.linalg.svd(rows, full_matrices=False)
    assert code.num_rows == len(rows)
    # The largest belong to demonstrations, which weigh more than 40 frames of play.
    np.testing.assert_allclose(
        np.linalg.norm(code.sketch, axis=1), lengths[:COMPONENTS], rtol=0.01
    )
    cosines = np.sum(np.asarray(code.sketch) * directions[:COMPONENTS], axis=1)
    np.testing.assert_allclose(np.abs(cosines) / lengths[:COMPONENTS], 1.0, atol=0.02)


def test_play_alone_can_make_a_component():
    moving = np.zeros((20, SIDE, SIDE, 3), np.uint8)
    moving[::2, 2, 3] = 255  # a pixel that no demonstration has
    still = experts(lengths=(9, 9))
    still = still._replace(frames=np.zeros_like(still.frames))
    code = observe(empty(), make_episode(moving), still)
    seen = np.asarray(encode_frames(code, moving))
    assert np.abs(seen[0] - seen[1]).max() > 1.0
    np.testing.assert_allclose(seen[0], seen[2], atol=1e-5)


@pytest.mark.parametrize("contrast", [1, 4])
def test_its_root_mean_square_is_8_at_any_contrast(contrast):
    frames = random_frames(1, 8) // contrast
    same = ExpertEpisodes(frames[None], np.asarray([8]), np.zeros((1, 0, 0)))
    code = observe(empty(), make_episode(frames), same)
    seen = np.asarray(encode_frames(code, frames))
    np.testing.assert_allclose(np.mean(np.sum(seen**2, axis=1)), 64.0, rtol=0.02)


def test_nothing_changes_it_once_it_is_fixed():
    code = observe(empty(), make_episode(random_frames(1, 20)), experts())
    other = make_episode(random_frames(2, 20))
    assert np.any(observe(code, other, experts()).sketch != code.sketch)
    fixed = code.replace(is_fixed=np.ones((), bool))
    after = observe(fixed, other, experts(3))
    jax.tree.map(np.testing.assert_array_equal, after, fixed)


def test_a_code_that_has_seen_nothing_gives_no_numbers():
    assert np.isnan(encode_frames(empty(), random_frames(1, 2))).all()


@pytest.mark.parametrize("stack", [1, 3])
def test_an_episode_has_the_codes_of_its_observations(stack):
    episode = make_episode(random_frames(1, 20))
    code, frames = observe(empty(), episode, experts()), jnp.asarray(episode.frames)
    stacked = stacking.stack_frames(frames, frame_stack=stack)
    np.testing.assert_allclose(
        codes.encode_episode(code, frames, frame_stack=stack),
        codes.encode(code, stacked, frame_stack=stack),
        atol=1e-4,
    )


def test_frames_without_any_variance_have_codes_of_zero():
    frames = np.full((5, SIDE, SIDE, 3), 7, np.uint8)
    still = experts()._replace(frames=np.full((2, 9, SIDE, SIDE, 3), 7, np.uint8))
    code = observe(empty(), make_episode(frames), still)
    seen = np.asarray(encode_frames(code, frames))
    assert np.isfinite(seen).all()
    np.testing.assert_allclose(seen, 0.0, atol=0.1)
