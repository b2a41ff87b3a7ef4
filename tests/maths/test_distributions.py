"""The clipped Gaussian: what is clipped, what is clamped, and every gradient."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized

from jaxil.maths import distributions

EDGE = np.float32(1.0 - 1e-6)


class ClampTest(chex.TestCase):
    def test_values_are_exact(self):
        actions = jnp.array([-7.0, -1.0, -0.3, 0.0, 0.3, 1.0, 7.0])
        clamped = jax.jit(distributions.clamp_straight_through)(actions)
        expected = np.array([-EDGE, -EDGE, -0.3, 0.0, 0.3, EDGE, EDGE], np.float32)
        np.testing.assert_array_equal(clamped, expected)

    def test_gradient_is_one_also_outside(self):
        weights = jnp.array([2.0, 3.0, 5.0])

        def weighted(actions):
            return jnp.sum(weights * distributions.clamp_straight_through(actions))

        gradient = jax.jit(jax.grad(weighted))(jnp.array([-4.0, 0.1, 4.0]))
        np.testing.assert_array_equal(gradient, weights)


class TruncatedNormalTest(chex.TestCase):
    @parameterized.parameters(0.05, 1.0)
    def test_is_the_mean_plus_clipped_noise(self, std):
        key = jax.random.key(0)
        mean = jnp.linspace(-0.9, 0.9, 300).reshape(100, 3)
        sample = functools.partial(
            distributions.sample_truncated_normal, noise_clip=0.3
        )
        actions = jax.jit(sample)(mean, jnp.asarray(std), key)
        noise = np.clip(std * np.asarray(jax.random.normal(key, (100, 3))), -0.3, 0.3)
        np.testing.assert_allclose(
            actions, np.clip(mean + noise, -EDGE, EDGE), atol=1e-6
        )

    def test_clips_the_noise_and_not_the_draw(self):
        # With std 1, |n| > 0.3 has probability 0.764; clipping n before it is
        # scaled would leave the same numbers here, so std 0.5 is asked as well:
        # P(|0.5 n| > 0.3) = P(|n| > 0.6) = 0.5485.
        for std, probability in ((1.0, 0.7642), (0.5, 0.5485)):
            actions = distributions.sample_truncated_normal(
                jnp.zeros((20_000, 1)),
                jnp.asarray(std),
                jax.random.key(1),
                noise_clip=0.3,
            )
            assert np.abs(actions).max() == np.float32(0.3)
            clipped = np.mean(np.abs(actions) == np.float32(0.3))
            np.testing.assert_allclose(clipped, probability, atol=0.015)

    def test_acting_noise_is_not_clipped(self):
        actions = distributions.sample_truncated_normal(
            jnp.zeros((20_000, 1)), jnp.asarray(0.2), jax.random.key(2), noise_clip=None
        )
        np.testing.assert_allclose(np.std(actions), 0.2, atol=0.005)
        assert np.abs(actions).max() > 0.6  # three standard deviations

    def test_gradient_towards_the_mean_is_one_where_clamped(self):
        mean = jnp.array([[-1.0, 0.0, 0.99, 1.0]] * 50)
        key = jax.random.key(3)

        def sample(mean):
            return distributions.sample_truncated_normal(
                mean, jnp.asarray(1.0), key, noise_clip=0.3
            )

        assert np.any(np.asarray(sample(mean)) == EDGE)
        gradient = jax.jit(jax.grad(lambda mean: jnp.sum(sample(mean))))(mean)
        np.testing.assert_array_equal(gradient, np.ones_like(mean))

    def test_without_noise_it_is_the_mean(self):
        mean = jnp.array([[-0.5, 0.25]])
        actions = distributions.sample_truncated_normal(
            mean, jnp.asarray(0.0), jax.random.key(0), noise_clip=0.3
        )
        np.testing.assert_array_equal(actions, mean)

    def test_rejects_a_vector_of_deviations(self):
        with pytest.raises(AssertionError):
            distributions.sample_truncated_normal(
                jnp.zeros((2, 3)), jnp.ones(3), jax.random.key(0), noise_clip=None
            )
