"""Trust in inferred actions, and the loss that clones them: worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.maths import cloning


def test_an_inference_error_sums_over_the_action_and_averages_over_the_rest():
    action = jnp.array([[0.0, 0.5], [1.0, -1.0]])
    right, wrong = action, action + jnp.array([[0.5, 0.0], [0.0, 1.0]])
    assert cloning.inference_error(wrong, action) == (0.25 + 1.0) / 2
    both = jnp.stack([right, wrong])
    assert cloning.inference_error(both, action) == (0.25 + 1.0) / 4


def test_disagreement_is_the_models_variance_summed_over_dimensions():
    # Two models, three transitions, two dimensions.
    actions = jnp.array(
        [
            [[0.5, 0.5], [1.0, 0.0], [1.0, -1.0]],
            [[0.5, 0.5], [0.0, 0.0], [-1.0, 1.0]],
        ]
    )
    np.testing.assert_allclose(cloning.disagreement(actions), [0.0, 0.25, 2.0])


def test_identical_models_are_trusted_wholly_and_others_by_their_distance():
    alike = jnp.tile(jnp.array([[[0.3, -0.7]]]), (3, 1, 1))
    distance = jnp.append(cloning.disagreement(alike), jnp.array([0.1, 0.2]))
    trust = cloning.agreement_trust(distance, scale=0.1)
    assert trust[0] == 1.0
    np.testing.assert_allclose(trust[1:], [np.exp(-1), np.exp(-2)], rtol=1e-6)


def test_the_filter_lets_through_what_the_smaller_critic_prefers():
    label = jnp.array([[2.0, 9.0, 1.0, 1.0], [3.0, 0.0, 1.0, -1.0]])
    policy = jnp.array([[1.0, 1.0, 1.0, -5.0], [4.0, 2.0, 1.0, 9.0]])
    # Smaller values: 2 > 1; 0 < 1; 1 = 1, which is not more; -1 > -5.
    np.testing.assert_array_equal(cloning.q_filter(label, policy), [1, 0, 0, 1])


def test_the_loss_weights_squared_distances_and_averages_over_all():
    action = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.5]])
    label = jnp.array([[1.0, 1.0], [0.0, 0.0], [-0.5, 0.5]])
    trust = jnp.array([0.5, 1.0, 0.0])
    # (0.5 * (1 + 1) / 2 + 1 * (1 + 0) / 2 + 0 * (1 + 0) / 2) / 3
    loss = cloning.trusted_cloning_loss(action, label, trust)
    np.testing.assert_allclose(loss, 1.0 / 3.0, rtol=1e-6)


def test_only_the_policy_is_differentiated():
    action, label, trust = jnp.zeros((1, 2)), jnp.array([[1.0, 0.5]]), jnp.ones(1)
    gradients = jax.grad(cloning.trusted_cloning_loss, (0, 1, 2))(action, label, trust)
    np.testing.assert_allclose(gradients[0], [[-1.0, -0.5]])
    assert not np.any(gradients[1])
    assert not np.any(gradients[2])


def test_the_scale_is_the_mean_size_of_the_smaller_value():
    values = jnp.array([[1.0, -4.0], [3.0, 2.0]])  # smaller: 1 and -4
    assert cloning.value_scale(values) == 2.5
    assert cloning.value_scale(10.0 * values) == 25.0
    assert not np.any(jax.grad(cloning.value_scale)(values))


@pytest.mark.parametrize(
    "call",
    [
        lambda: cloning.inference_error(jnp.zeros((3, 1)), jnp.zeros((3, 2))),
        lambda: cloning.inference_error(jnp.zeros((3, 4, 2)), jnp.zeros((1, 2))),
        lambda: cloning.disagreement(jnp.zeros((3, 2))),
        lambda: cloning.agreement_trust(jnp.zeros((3, 1)), scale=0.1),
        lambda: cloning.q_filter(jnp.zeros((2, 3)), jnp.zeros((2, 4))),
        lambda: cloning.trusted_cloning_loss(
            jnp.zeros((3, 2)), jnp.zeros((3, 2)), jnp.zeros((3, 1))
        ),
        lambda: cloning.trusted_cloning_loss(
            jnp.zeros((3, 2)), jnp.zeros((3, 2)), jnp.zeros(2)
        ),
        lambda: cloning.value_scale(jnp.zeros(3)),
    ],
)
def test_other_shapes_are_refused(call):
    with pytest.raises(AssertionError):
        call()
