"""The distance to the expert: zero to oneself, one at random, the same for all runs."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil.demonstrations.loading import Demonstrations
from jaxil.environments.interaction import FinishedEpisode
from jaxil.training import expert_distance

SIDE = 20


def draw(seed, count):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (count, SIDE, SIDE, 3), dtype=np.uint8)


def episode(frames):
    steps = len(frames) - 1
    zeros = np.zeros(steps, np.float32)
    return FinishedEpisode(frames, np.zeros((steps, 1), np.float32), zeros, zeros)


def demonstrations(*episodes):
    longest = max(len(frames) for frames in episodes)
    padded = [
        np.concatenate([frames, np.repeat(frames[-1:], longest - len(frames), 0)])
        for frames in episodes
    ]
    lengths = np.array([len(frames) for frames in episodes])
    return Demonstrations(np.stack(padded), lengths, None, None, {"returns": []})


def small_config():
    config = jaxil_config.default_config("pdac", "cartpole_swingup")
    config.image_size = SIDE
    config.action_repeat = 50  # 20 decisions in an episode
    config.render_quality = "fast"
    return config


def test_mean_over_pairs_by_hand():
    # One moment each, at right angles or the same: costs 0, 1, 1, 0 of four pairs.
    east, north = jnp.array([[[1.0, 0.0]]]), jnp.array([[[0.0, 1.0]]])
    both = jnp.concatenate([east, north])
    np.testing.assert_allclose(
        expert_distance.mean_distance(both, both), 0.5, atol=1e-5
    )


def test_one_encoder_for_all():
    frames = draw(0, 9)
    first, second = (
        expert_distance.make_random_embedding((SIDE, SIDE, 3), 3)(frames)
        for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
    assert first.shape == (128, 50)


@pytest.mark.parametrize("side", [3, 8, 15, 48])
def test_small_images_are_embedded_too(side):
    frames = np.zeros((4, side, side, 3), np.uint8)
    assert (
        expert_distance.make_random_embedding((side, side, 3), 1)(frames).shape[0]
        == 128
    )
    states = np.zeros((4, side), np.float32)
    assert expert_distance.make_random_embedding((side,), 1)(states).shape[0] == 128


def test_random_actions_are_at_one_and_the_expert_is_nearer(tmp_path):
    # The random policy's own episodes stand in for an evaluation.
    config = small_config()
    own = draw(0, 21)
    measure = expert_distance.Closeness(config, tmp_path, demonstrations(own))
    played = []
    real = expert_distance.evaluate

    def spy(*args, **kwargs):
        played.append(real(*args, **kwargs))
        return played[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(expert_distance, "evaluate", spy)
        near = measure.relative_distance([episode(own)])
        at_random = measure.relative_distance(played[0].episodes)
    assert at_random == pytest.approx(1.0, rel=1e-5)
    assert near < 0.05
    assert len(played) == 1  # played once, then read from the run's folder
    again = expert_distance.Closeness(config, tmp_path, demonstrations(own))
    assert again.relative_distance([episode(own)]) == pytest.approx(near, rel=1e-6)


def test_what_fills_up_a_short_demonstration_does_not_count(tmp_path):
    config, short, long = small_config(), draw(1, 12), draw(2, 21)
    (tmp_path / "random_policy.json").write_text('{"distance": 1.0}')
    agent = [episode(draw(3, 21))]
    alone = [
        expert_distance.Closeness(
            config, tmp_path, demonstrations(one)
        ).relative_distance(agent)
        for one in (short, long)
    ]
    together = expert_distance.Closeness(config, tmp_path, demonstrations(short, long))
    expected = np.mean(alone)
    assert together.relative_distance(agent) == pytest.approx(expected, rel=1e-4)
