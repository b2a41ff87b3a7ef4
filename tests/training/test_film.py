"""Films of evaluations."""

import numpy as np
import pytest

from jaxil.config import default_config
from jaxil.environments.evaluation import Stopped, evaluate
from jaxil.training import assembly, film
from tests.demonstrations import foreign_files


def _played(method):
    """Returns a config, its environment, and an evaluation of five steps."""
    config = default_config(method, "cartpole_swingup")
    config.observation, config.action_repeat = "state", 10
    config.max_episode_frames, config.render_quality = 50, "fast"
    environment = assembly.evaluation_environment(config)
    evaluation = evaluate(
        environment,
        lambda _: np.zeros(1),
        num_episodes=1,
        first_episode=3,
        record=film.recorder(environment, 32),
    )
    return config, environment, evaluation


def test_a_request_to_stop_ends_the_rendering():
    played, asked = _played("zero"), iter([False, False, True])
    with pytest.raises(Stopped):
        film.sides(
            *played, first_episode=3, image_size=32, stop_asked=lambda: next(asked)
        )
    (side,) = film.sides(*played, first_episode=3, image_size=32)
    assert side.frames.shape == (6, 32, 32, 3)
    assert side.captions[-1].startswith("agent  0.5 s  return ")


def test_the_expert_is_shown_without_repeating_what_the_run_has_warned_of(
    tmp_path, caplog
):
    config, environment, evaluation = _played("pdac")
    config.demonstrations.source = str(tmp_path / "expert.npz")
    foreign_files.write_own(tmp_path / "expert.npz", 1)
    _, expert = film.sides(
        config, environment, evaluation, first_episode=3, image_size=32
    )
    assert expert.frames.shape == (4, 32, 32, 3)
    assert expert.captions[0] == "expert  0.0 s  return 0"
    assert not caplog.records
