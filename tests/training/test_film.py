"""Films of evaluations."""

import numpy as np
import pytest

from jaxil.config import default_config
from jaxil.environments.evaluation import Stopped, evaluate
from jaxil.training import assembly, film


def test_a_request_to_stop_ends_the_rendering():
    config = default_config("zero", "cartpole_swingup")
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
    asked = iter([False, False, True])
    with pytest.raises(Stopped):
        film.sides(
            config,
            environment,
            evaluation,
            first_episode=3,
            image_size=32,
            stop_asked=lambda: next(asked),
        )
    (side,) = film.sides(
        config, environment, evaluation, first_episode=3, image_size=32
    )
    assert side.frames.shape == (6, 32, 32, 3)
    assert side.captions[-1].startswith("agent  0.5 s  return ")
