"""Losses at numbers worked by hand, their gradients, and their extremes."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized

from jaxil.maths import losses


class TdTargetTest(chex.TestCase):
    def test_by_hand(self):
        target = jax.jit(losses.td_target)(
            jnp.array([1.0, -1.0, 0.5]),
            jnp.array([0.5, 0.0, 1.0]),
            jnp.array([[2.0, 3.0, -4.0], [4.0, 1.0, -3.0]]),
        )
        # 1 + 0.5 min(2, 4);  -1 + 0 (terminated);  0.5 + min(-4, -3)
        np.testing.assert_allclose(target, [2.0, -1.0, -3.5])

    def test_has_no_gradient(self):
        gradients = jax.grad(
            lambda *inputs: jnp.sum(losses.td_target(*inputs)), argnums=(0, 1, 2)
        )(jnp.ones(3), jnp.ones(3), jnp.ones((2, 3)))
        for gradient in gradients:
            np.testing.assert_array_equal(gradient, np.zeros_like(gradient))

    @parameterized.parameters(((3, 1), (3,)), ((3,), (4,)))
    def test_rejects_shapes_that_would_broadcast(self, reward_shape, discount_shape):
        with pytest.raises(AssertionError):
            losses.td_target(
                jnp.ones(reward_shape), jnp.ones(discount_shape), jnp.ones((2, 3))
            )


class CriticLossTest(chex.TestCase):
    def test_by_hand(self):
        values = jnp.array([[1.0, 2.0], [3.0, 5.0]])
        # mean(1, 0) + mean(9, 9)
        loss = jax.jit(losses.critic_loss)(values, jnp.array([0.0, 2.0]))
        np.testing.assert_allclose(loss, 9.5)

    def test_gradient_is_twice_the_error_over_the_batch(self):
        values, target = jnp.array([[1.0, 2.0], [3.0, 5.0]]), jnp.array([0.0, 2.0])
        gradient = jax.grad(losses.critic_loss)(values, target)
        np.testing.assert_allclose(gradient, [[1.0, 0.0], [3.0, 3.0]])

    def test_rejects_a_column_of_targets(self):
        with pytest.raises(AssertionError):
            losses.critic_loss(jnp.ones((2, 3)), jnp.ones((3, 1)))


class ActorLossTest(chex.TestCase):
    def test_by_hand(self):
        values = jnp.array([[1.0, 5.0], [2.0, 3.0]])
        np.testing.assert_allclose(jax.jit(losses.actor_loss)(values), -2.0)

    def test_raises_the_smaller_value_only(self):
        gradient = jax.grad(losses.actor_loss)(jnp.array([[1.0, 5.0], [2.0, 3.0]]))
        np.testing.assert_allclose(gradient, [[-0.5, 0.0], [0.0, -0.5]])

    def test_saturation_penalty_by_hand(self):
        penalty = losses.saturation_penalty(jnp.array([[1.0, -3.0], [0.0, 2.0]]))
        np.testing.assert_allclose(penalty, (1.0 + 9.0 + 0.0 + 4.0) / 4.0)


class DiscriminatorLossTest(chex.TestCase):
    @parameterized.parameters(
        # D = 1/2 for all: -log(1/2) twice.
        ([0.0, 0.0], [0.0, 0.0], 2.0 * np.log(2.0)),
        # D(e) = 3/4 and D(a) = 1/4, both right.
        ([np.log(3.0)], [-np.log(3.0)], 2.0 * np.log(4.0 / 3.0)),
        # Both wrong: dearer than not knowing. The labels are not swapped.
        ([-np.log(3.0)], [np.log(3.0)], 2.0 * np.log(4.0)),
        # Means over samples: (log 4/3 + log 4) / 2 + log 2.
        (
            [np.log(3.0), -np.log(3.0)],
            [0.0, 0.0],
            0.5 * np.log(16.0 / 3.0) + np.log(2.0),
        ),
    )
    def test_by_hand(self, expert, agent, expected):
        loss = jax.jit(losses.discriminator_loss)(jnp.array(expert), jnp.array(agent))
        np.testing.assert_allclose(loss, expected, rtol=1e-6)

    @parameterized.parameters(1e4, -1e4)
    def test_extremes_are_finite(self, logit):
        value, gradients = jax.value_and_grad(
            losses.discriminator_loss, argnums=(0, 1)
        )(jnp.array([logit]), jnp.array([-logit]))
        chex.assert_tree_all_finite((value, gradients))
        np.testing.assert_allclose(value, 0.0 if logit > 0 else 2e4)
        slope = 0.0 if logit > 0 else 1.0
        np.testing.assert_allclose(gradients, [[-slope], [slope]])

    def test_rejects_unequal_batches(self):
        with pytest.raises(AssertionError):
            losses.discriminator_loss(jnp.ones(3), jnp.ones(4))


class GradientPenaltyTest(chex.TestCase):
    @parameterized.parameters(((3.0, 4.0), 16.0), ((0.6, 0.8), 0.0), ((0.0, 0.5), 0.25))
    def test_of_a_linear_discriminator(self, weights, expected):
        # The gradient is w everywhere: (|w| - 1)^2.
        w = jnp.array(weights)
        expert, agent = jax.random.normal(jax.random.key(0), (2, 7, 2))
        penalty = jax.jit(
            lambda e, a, k: losses.gradient_penalty(lambda x: x @ w, e, a, k)
        )(expert, agent, jax.random.key(1))
        np.testing.assert_allclose(penalty, expected, atol=1e-5)

    def test_gradient_towards_weights(self):
        # d (|w| - 1)^2 / dw = 2 (|w| - 1) w / |w|, at w = (3, 4): 8 (3, 4) / 5
        expert, agent = jax.random.normal(jax.random.key(0), (2, 7, 2))

        def penalty(w):
            return losses.gradient_penalty(
                lambda x: x @ w, expert, agent, jax.random.key(1)
            )

        gradient = jax.grad(penalty)(jnp.array([3.0, 4.0]))
        np.testing.assert_allclose(gradient, [4.8, 6.4], rtol=1e-5)

    def test_a_flat_discriminator_has_finite_gradients(self):
        def penalty(w):
            return losses.gradient_penalty(
                lambda x: x @ w, jnp.ones((4, 2)), jnp.zeros((4, 2)), jax.random.key(0)
            )

        value, gradient = jax.value_and_grad(penalty)(jnp.zeros(2))
        np.testing.assert_allclose(value, 1.0, atol=1e-5)
        chex.assert_tree_all_finite(gradient)

    def test_each_row_is_mixed_by_a_draw_of_its_own(self):
        # l(x) = x^2 / 2 has gradient x, so the penalty reads the mix itself: with
        # e = 3 and a = 1, x = 1 + 2 u and E (x - 1)^2 = 4 E u^2 = 4 / 3. A single
        # draw for the whole batch would land there only by chance.
        rows = jnp.ones((20_000, 1))
        for seed in range(3):
            penalty = losses.gradient_penalty(
                lambda x: 0.5 * jnp.sum(x**2, axis=1),
                3.0 * rows,
                rows,
                jax.random.key(seed),
            )
            np.testing.assert_allclose(penalty, 4.0 / 3.0, atol=0.04)

    def test_the_mix_lies_between_its_own_pair(self):
        # Rows with e = a stay where they are: mean of (|x| - 1)^2.
        points = jnp.array([[0.0, 2.0], [3.0, 4.0]])
        penalty = losses.gradient_penalty(
            lambda x: 0.5 * jnp.sum(x**2, axis=1), points, points, jax.random.key(0)
        )
        np.testing.assert_allclose(penalty, (1.0 + 16.0) / 2.0, rtol=1e-5)


class PredictionLossTest(chex.TestCase):
    def test_by_hand(self):
        # Features 1 and 5 are one standard deviation from their mean, 3.
        features = jnp.array([[1.0, 10.0], [5.0, 20.0]])
        loss = jax.jit(losses.prediction_loss)
        right = jnp.array([[-1.0, -1.0], [1.0, 1.0]])
        np.testing.assert_allclose(loss(right, features), 0.0, atol=1e-10)
        # (4 + 0 + 0 + 1) / 4
        other = jnp.array([[1.0, -1.0], [1.0, 0.0]])
        np.testing.assert_allclose(loss(other, features), 1.25, rtol=1e-5)

    @parameterized.parameters(1.0, 1e-3)
    def test_small_features_are_no_easier_to_guess(self, scale):
        """A constant costs 1, however close the features have come to one."""
        features = 0.5 + scale * jax.random.normal(jax.random.key(0), (64, 5))
        loss = losses.prediction_loss(jnp.zeros((64, 5)), features)
        np.testing.assert_allclose(loss, 1.0, rtol=1e-2)
        guess = jnp.tile(jnp.linspace(-0.2, 0.3, 5)[None], (64, 1))
        assert losses.prediction_loss(guess, features) > loss

    def test_the_target_has_no_gradient_and_may_be_constant(self):
        value, gradients = jax.value_and_grad(losses.prediction_loss, argnums=(0, 1))(
            jnp.ones((4, 2)), jnp.full((4, 2), 0.3)
        )
        np.testing.assert_allclose(value, 1.0)
        np.testing.assert_allclose(gradients[0], np.full((4, 2), 2 / 8))
        np.testing.assert_array_equal(gradients[1], np.zeros((4, 2)))

    def test_rejects_unequal_shapes(self):
        with pytest.raises(AssertionError):
            losses.prediction_loss(jnp.ones((4, 2)), jnp.ones((4, 1)))
