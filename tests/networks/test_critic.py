"""The twin critics: sizes by hand, one trunk, two heads, the action after it."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.networks.agent import apply, critic_features
from jaxil.networks.critic import Critic
from jaxil.networks.layers import MLP, Trunk
from tests.tiny_agent import NETWORKS, make_tiny_networks

TINY = Critic(feature_dim=5, hidden_dim=6)


def num_parameters(tree):
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def inputs(batch=3):
    keys = jax.random.split(jax.random.key(0), 2)
    return jax.random.normal(keys[0], (batch, 8)), jax.random.uniform(
        keys[1], (batch, 2)
    )


def test_parameters_at_the_papers_size():
    critic = Critic(feature_dim=50, hidden_dim=1024)
    shapes = [jax.ShapeDtypeStruct((2, size), jnp.float32) for size in (39_200, 6)]
    params = jax.eval_shape(critic.init, jax.random.key(0), *shapes)
    trunk = 39_200 * 50 + 50 + 2 * 50
    head = ((50 + 6) * 1024 + 1024) + (1024 * 1024 + 1024) + (1024 + 1)
    assert num_parameters(params["params"]["trunk"]) == trunk == 1_960_150
    assert num_parameters(params["params"]["value_1"]) == head == 1_108_993
    assert num_parameters(params) == trunk + 2 * head  # one trunk, two heads
    assert jax.eval_shape(critic.apply, params, *shapes).shape == (2, 2)


class CriticTest(chex.TestCase):
    def test_each_value_is_an_mlp_of_features_and_action(self):
        representation, action = inputs()
        params = TINY.init(jax.random.key(1), representation, action)
        layers = params["params"]
        features = apply(Trunk(5), {"params": layers["trunk"]}, representation)
        joined = jnp.concatenate([features, action], axis=1)
        values = jax.jit(TINY.apply)(params, representation, action)
        assert values.shape == (2, 3)
        for value, name in zip(values, ("value_1", "value_2"), strict=True):
            expected = apply(MLP(6, 1), {"params": layers[name]}, joined)
            np.testing.assert_allclose(value, expected[:, 0], atol=1e-6)

    def test_heads_start_apart(self):
        representation, action = inputs()
        params = TINY.init(jax.random.key(1), representation, action)
        first, second = apply(TINY, params, representation, action)
        assert np.abs(first - second).max() > 1e-2

    def test_features_then_values_is_the_whole(self):
        representation, action = inputs()
        params = TINY.init(jax.random.key(1), representation, action)
        features = apply(TINY, params, representation, method=TINY.features)
        values = apply(TINY, params, features, action, method=TINY.values)
        np.testing.assert_array_equal(
            values, apply(TINY, params, representation, action)
        )

    def test_rejects_one_action_for_a_batch(self):
        representation, action = inputs()
        params = TINY.init(jax.random.key(1), representation, action)
        with pytest.raises(AssertionError):
            apply(TINY, params, representation, action[0])


def test_features_of_agent_networks_are_the_critics_and_not_the_actors():
    images = np.random.default_rng(0).integers(0, 256, (3, 12, 12, 3), dtype=np.uint8)
    encoder = NETWORKS.encoder.init(jax.random.key(0), images)
    representation = apply(NETWORKS.encoder, encoder, images)
    critic = NETWORKS.critic.init(jax.random.key(1), representation, jnp.zeros((3, 2)))
    trunk = apply(Trunk(5), {"params": critic["params"]["trunk"]}, representation)
    features = critic_features(NETWORKS, encoder, critic, jnp.asarray(images))
    np.testing.assert_allclose(features, trunk, atol=1e-6)


def test_state_vectors_reach_the_trunk_through_the_encoders_hidden_layer():
    networks = make_tiny_networks(observation="state")
    vectors = jax.random.normal(jax.random.key(0), (3, 7))
    encoder = networks.encoder.init(jax.random.key(0), vectors)
    hidden = apply(networks.encoder, encoder, vectors)
    assert hidden.shape == (3, 6)
    critic = networks.critic.init(jax.random.key(1), hidden, jnp.zeros((3, 2)))
    trunk = apply(Trunk(5), {"params": critic["params"]["trunk"]}, hidden)
    features = critic_features(networks, encoder, critic, vectors)
    np.testing.assert_allclose(features, trunk, atol=1e-6)
