"""Acting: the mean without noise, and noise whose size follows agent steps."""

import jax
import numpy as np
import optax

from jaxil.learner.policy import make_mean_action, make_sample_action
from jaxil.networks.agent import apply
from tests.tiny_agent import NETWORKS, make_params, random_frames

PARAMS = make_params(0)
ENCODER, ACTOR = PARAMS.encoder, PARAMS.actor
KEY = jax.random.key(2)
MEAN = jax.jit(make_mean_action(NETWORKS))


def test_the_mean_action_is_the_tanh_of_the_actors_output():
    observations = random_frames(0, 3)
    representation = apply(NETWORKS.encoder, ENCODER, observations)
    mean = np.tanh(apply(NETWORKS.actor, ACTOR, representation))
    action = MEAN(ENCODER, ACTOR, observations)
    assert action.shape == (3, 2)
    np.testing.assert_allclose(action, mean, atol=1e-6)


def test_noise_has_the_schedules_size_and_its_draw_follows_from_the_step():
    schedule = optax.linear_schedule(1.0, 0.0, 1000)
    sample_action = jax.jit(make_sample_action(NETWORKS, schedule))
    steps = np.array([0, 500, 900, 5000], np.uint32)
    observations = random_frames(0, len(steps))
    means = MEAN(ENCODER, ACTOR, observations)
    actions = sample_action(ENCODER, ACTOR, observations, KEY, steps)
    for mean, action, step, std in zip(means, actions, steps, (1.0, 0.5, 0.1, 0.0)):
        noise = jax.random.normal(jax.random.fold_in(KEY, step), (2,))
        expected = np.clip(mean + std * noise, -1 + 1e-6, 1 - 1e-6)
        np.testing.assert_allclose(action, expected, atol=1e-6)
    # An action depends on its own row alone, so that environments side by side play
    # what each of them would play alone.
    alone = sample_action(ENCODER, ACTOR, observations[1:2], KEY, steps[1:2])
    np.testing.assert_allclose(alone[0], actions[1], atol=1e-6)


def test_noise_is_not_clipped_as_in_updates():
    sample_action = make_sample_action(NETWORKS, optax.constant_schedule(0.5))
    observations = random_frames(0, 1).repeat(50, axis=0)
    mean = np.asarray(MEAN(ENCODER, ACTOR, observations))
    actions = sample_action(ENCODER, ACTOR, observations, KEY, np.arange(50))
    assert np.all(np.abs(actions) < 1.0)
    assert np.abs(actions - mean).max() > 0.6  # the clip would be 0.3
    assert len(np.unique(actions, axis=0)) == 50  # each step has noise of its own
