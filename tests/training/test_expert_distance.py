"""The distance to the expert: zero for itself, one for random actions."""

import contextlib
import types

import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil.demonstrations.loading import Demonstrations
from jaxil.environments.evaluation import Evaluation
from jaxil.maths.types import Episode
from jaxil.training import expert_distance

SIDE = 20


def draw(seed, count):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (count, SIDE, SIDE, 3), dtype=np.uint8)


def episode(frames):
    steps = len(frames) - 1
    zeros = np.zeros(steps, np.float32)
    return Episode(frames, np.zeros((steps, 1), np.float32), zeros, zeros)


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
    config.action_repeat = 50  # 20 steps in an episode
    config.render_quality = "fast"
    return config


def test_one_encoder_for_all():
    frames = draw(0, 9)
    first, second = (
        expert_distance.make_random_embedding((SIDE, SIDE, 3), 3)(frames)
        for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
    assert first.shape == (64, 50)


@pytest.mark.parametrize("side", [3, 15])
def test_small_images_are_embedded_too(side):
    frames = np.zeros((4, side, side, 3), np.uint8)
    assert (
        expert_distance.make_random_embedding((side, side, 3), 1)(frames).shape[0] == 64
    )
    states = np.zeros((4, side), np.float32)
    assert expert_distance.make_random_embedding((side,), 1)(states).shape[0] == 64


def test_the_expert_itself_is_at_zero_and_a_random_policy_at_one(tmp_path, monkeypatch):
    played, real = [], expert_distance.evaluate

    def spy(*args, **kwargs):
        played.append(real(*args, **kwargs))
        return played[-1]

    monkeypatch.setattr(expert_distance, "evaluate", spy)
    config, own, other = small_config(), draw(0, 21), draw(2, 21)
    half = np.concatenate([own[:11], other[11:]])
    measure = expert_distance.ExpertDistance(config, tmp_path, demonstrations(own, own))
    expert, near, far = (
        measure.relative_distance([episode(frames)]) for frames in (own, half, other)
    )
    assert expert == pytest.approx(0.0, abs=1e-4)
    assert 0.01 < near < 0.9 * far
    assert measure.relative_distance(played[0].episodes) == pytest.approx(1.0, rel=1e-5)
    assert len(played) == 1  # played once, then read from the run's folder


def test_a_stored_distance_is_used_if_it_verifies(tmp_path, monkeypatch):
    played = []

    def play(*_, **__):
        played.append(None)
        return Evaluation([episode(draw(5, 9))], np.array([3.0]), [])

    monkeypatch.setattr(expert_distance, "evaluate", play)
    environment = types.SimpleNamespace(action_spec=lambda: np.zeros(1))
    monkeypatch.setattr(
        expert_distance.assembly,
        "environment_with_seed",
        lambda *_: contextlib.nullcontext(environment),
    )
    path = tmp_path / "random_policy.json"
    own = demonstrations(draw(0, 21))
    measure = expert_distance.ExpertDistance(small_config(), tmp_path, own)
    agent = [episode(draw(2, 21))]
    expected = measure.relative_distance(agent)
    assert measure.relative_distance(agent) == expected
    assert len(played) == 1
    stored = path.read_text()
    for damaged in (
        stored.replace('"distance": 0.', '"distance": 0.1'),
        "",
        '{"distance": 0, "checksum": 0}',
        '{"distance": NaN}',
        "[" * 100_000,
        '{"distance": 0.25, "task_return_mean": 3.0}',  # by an earlier definition
    ):
        assert damaged != stored
        path.write_text(damaged)
        assert measure.relative_distance(agent) == expected
        assert path.read_text() == stored
    assert len(played) == 7


def test_the_padding_of_a_short_demonstration_does_not_count(tmp_path):
    short = draw(1, 12)
    padded = demonstrations(short)._replace(
        frames=np.concatenate([short, draw(2, 9)])[None]
    )
    agent = [episode(draw(3, 21))]
    distances = [
        expert_distance.ExpertDistance(small_config(), tmp_path, each)._distance(agent)
        for each in (demonstrations(short), padded)
    ]
    assert distances[0] == distances[1]
