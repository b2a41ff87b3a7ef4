"""Acting: the mean without noise, and noise whose size follows agent steps."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxil.learner.policy import make_exploit, make_explore
from jaxil.networks.agent import apply
from tests.tiny_agent import make_tiny_networks

with_and_without_jit: Any = chex.variants(with_jit=True, without_jit=True)

NETWORKS = make_tiny_networks(action_dim=3)
SCHEDULE = optax.linear_schedule(1.0, 0.0, 1000)


def tiny_params():
    images = np.random.default_rng(0).integers(0, 256, (1, 12, 12, 3), dtype=np.uint8)
    encoder = NETWORKS.encoder.init(jax.random.key(0), images)
    representation = apply(NETWORKS.encoder, encoder, images)
    return encoder, NETWORKS.actor.init(jax.random.key(1), representation), images[0]


class ExploitTest(chex.TestCase):
    @with_and_without_jit
    def test_is_the_tanh_of_the_actors_mean(self):
        encoder, actor, observation = tiny_params()
        action = self.variant(make_exploit(NETWORKS))(encoder, actor, observation)
        representation = apply(NETWORKS.encoder, encoder, observation[None])
        mean = np.tanh(apply(NETWORKS.actor, actor, representation))
        assert action.shape == (3,)
        np.testing.assert_allclose(action, mean[0], atol=1e-6)


class ExploreTest(chex.TestCase):
    @with_and_without_jit
    def test_adds_noise_of_the_schedules_size(self):
        encoder, actor, observation = tiny_params()
        mean = make_exploit(NETWORKS)(encoder, actor, observation)
        explore = self.variant(make_explore(NETWORKS, SCHEDULE))
        key = jax.random.key(2)
        for num_steps, std in ((0, 1.0), (500, 0.5), (900, 0.1)):
            action = explore(encoder, actor, observation, key, jnp.uint32(num_steps))
            noise = jax.random.normal(jax.random.fold_in(key, num_steps), (3,))
            expected = np.clip(mean + std * noise, -1 + 1e-6, 1 - 1e-6)
            np.testing.assert_allclose(action, expected, atol=1e-6)

    def test_ends_without_noise(self):
        encoder, actor, observation = tiny_params()
        explore = make_explore(NETWORKS, SCHEDULE)
        action = explore(
            encoder, actor, observation, jax.random.key(2), jnp.uint32(5000)
        )
        np.testing.assert_array_equal(
            action, make_exploit(NETWORKS)(encoder, actor, observation)
        )

    def test_noise_is_not_clipped_as_in_updates(self):
        encoder, actor, observation = tiny_params()
        mean = np.asarray(make_exploit(NETWORKS)(encoder, actor, observation))
        explore = jax.jit(make_explore(NETWORKS, optax.constant_schedule(0.5)))
        actions = np.stack(
            [
                explore(encoder, actor, observation, jax.random.key(2), jnp.uint32(n))
                for n in range(50)
            ]
        )
        assert np.all(np.abs(actions) < 1.0)
        assert np.abs(actions - mean[None]).max() > 0.6  # the clip would be 0.3
        assert len(np.unique(actions, axis=0)) == 50  # each step draws afresh
