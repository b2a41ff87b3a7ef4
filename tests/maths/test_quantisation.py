"""Vector quantisation at numbers worked by hand, and where its gradients go."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.maths import quantisation

# Two parts of two numbers, with three codes each.
CODEBOOK = jnp.array(
    [
        [[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]],
        [[1.0, 1.0], [-1.0, -1.0], [9.0, 9.0]],
    ]
)
LATENT = jnp.array(
    [
        [[1.4, 0.2], [0.5, -0.1]],  # 0 is at 2.00, 3 at 2.60; 1 at 1.46, -1 at 3.06
        [[1.6, 0.2], [-0.5, 0.1]],  # 0 is at 2.60, 3 at 2.00; 1 at 3.06, -1 at 1.46
        [[0.5, 3.0], [-7.0, -7.0]],
    ]
)
INDICES = [[0, 0], [1, 1], [2, 1]]


class QuantisationTest(chex.TestCase):
    def test_each_part_goes_to_the_nearest_of_its_own_codes(self):
        indices = jax.jit(quantisation.nearest_codes)(LATENT, CODEBOOK)
        np.testing.assert_array_equal(indices, INDICES)
        codes = jax.jit(quantisation.look_up)(indices, CODEBOOK)
        expected = [[[0, 0], [1, 1]], [[3, 0], [-1, -1]], [[0, 4], [-1, -1]]]
        np.testing.assert_array_equal(codes, expected)

    def test_no_code_is_nearer(self):
        keys = jax.random.split(jax.random.key(0))
        latent = jax.random.normal(keys[0], (50, 3, 4))
        codebook = jax.random.normal(keys[1], (3, 7, 4))
        indices = quantisation.nearest_codes(latent, codebook)
        distances = np.linalg.norm(latent[:, :, None] - codebook[None], axis=-1)
        np.testing.assert_array_equal(indices, np.argmin(distances, axis=-1))

    def test_a_code_is_its_own_nearest(self):
        latent = jnp.swapaxes(CODEBOOK, 0, 1)
        indices = quantisation.nearest_codes(latent, CODEBOOK)
        np.testing.assert_array_equal(indices, [[0, 0], [1, 1], [2, 2]])

    def test_the_gradient_passes_as_if_nothing_were_quantised(self):
        weight = jax.random.normal(jax.random.key(0), LATENT.shape)

        def output(latent, codebook):
            indices = quantisation.nearest_codes(latent, codebook)
            code = quantisation.look_up(indices, codebook)
            passed = quantisation.straight_through(latent, code)
            return jnp.sum(weight * passed), (passed, code)

        (_, (passed, code)), (to_latent, to_codebook) = jax.value_and_grad(
            output, argnums=(0, 1), has_aux=True
        )(LATENT, CODEBOOK)
        np.testing.assert_allclose(passed, code, atol=1e-6)
        np.testing.assert_array_equal(to_latent, weight)
        np.testing.assert_array_equal(to_codebook, np.zeros_like(CODEBOOK))

    def test_losses_by_hand_and_what_each_of_them_moves(self):
        def both(latent, codebook):
            code = quantisation.look_up(jnp.array(INDICES), codebook)
            return (
                quantisation.codebook_loss(latent, code),
                quantisation.commitment_loss(latent, code),
            )

        # 1.96 + 0.04, 0.25 + 1.21; 1.96 + 0.04, 0.25 + 1.21; 0.25 + 1, 36 + 36
        expected = (2.0 + 1.46 + 2.0 + 1.46 + 1.25 + 72.0) / 12
        np.testing.assert_allclose(both(LATENT, CODEBOOK), [expected] * 2, rtol=1e-5)
        jacobian = jax.jacrev(both, argnums=(0, 1))(LATENT, CODEBOOK)
        (codebook_to_latent, codebook_to_codes) = jacobian[0]
        (commitment_to_latent, commitment_to_codes) = jacobian[1]
        np.testing.assert_array_equal(codebook_to_latent, np.zeros_like(LATENT))
        np.testing.assert_array_equal(commitment_to_codes, np.zeros_like(CODEBOOK))
        code = quantisation.look_up(jnp.array(INDICES), CODEBOOK)
        toward = 2.0 * (LATENT - code) / 12
        np.testing.assert_allclose(commitment_to_latent, toward, rtol=1e-5)
        # A code moves towards all of its vectors, and stays if it has none.
        np.testing.assert_allclose(
            codebook_to_codes[1, 1], -(toward[1, 1] + toward[2, 1]), rtol=1e-5
        )
        np.testing.assert_array_equal(codebook_to_codes[1, 2], [0.0, 0.0])

    def test_perplexity_counts_codes_that_are_used(self):
        # The first part uses four codes equally, the second one: (4 + 1) / 2.
        indices = jnp.array([[0, 2], [1, 2], [2, 2], [3, 2]])
        count = jax.jit(lambda x: quantisation.perplexity(x, num_codes=5))(indices)
        np.testing.assert_allclose(count, 2.5, rtol=1e-6)
        # Shares of 3/4 and 1/4: exp(0.75 log(4/3) + 0.25 log 4)
        count = quantisation.perplexity(jnp.array([[0], [0], [0], [1]]), num_codes=2)
        np.testing.assert_allclose(count, (4 / 3) ** 0.75 * 4**0.25, rtol=1e-6)

    def test_rejects_shapes_that_would_broadcast(self):
        with pytest.raises(AssertionError):
            quantisation.nearest_codes(LATENT[:, :1], CODEBOOK)
        with pytest.raises(AssertionError):
            quantisation.nearest_codes(LATENT[..., :1], CODEBOOK)
        with pytest.raises(AssertionError):
            quantisation.look_up(jnp.zeros((3, 1), jnp.int32), CODEBOOK)
        for function in (
            quantisation.straight_through,
            quantisation.codebook_loss,
            quantisation.commitment_loss,
        ):
            with pytest.raises(AssertionError):
                function(LATENT, LATENT[:1])
