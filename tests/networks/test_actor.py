"""The trunk, the MLP and the actor: sizes by hand, layers by their definitions."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxil.networks.actor import Actor
from jaxil.networks.agent import actor_features, apply
from jaxil.networks.layers import MLP, Trunk
from tests.tiny_agent import NETWORKS


def num_parameters(tree):
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def assert_orthogonal(kernel):
    """W^T W = I, or W W^T = I where there are more outputs than inputs."""
    kernel = np.asarray(kernel)
    if kernel.shape[0] < kernel.shape[1]:
        kernel = kernel.T
    np.testing.assert_allclose(kernel.T @ kernel, np.eye(kernel.shape[1]), atol=1e-5)


def test_parameters_at_the_papers_size():
    actor = Actor(action_dim=6, feature_dim=50, hidden_dim=1024)
    representation = jax.ShapeDtypeStruct((2, 39_200), jnp.float32)
    params = jax.eval_shape(actor.init, jax.random.key(0), representation)
    trunk = 39_200 * 50 + 50 + 2 * 50  # linear, then LayerNorm's scale and shift
    head = (50 * 1024 + 1024) + (1024 * 1024 + 1024) + (1024 * 6 + 6)
    assert num_parameters(params["params"]["trunk"]) == trunk == 1_960_150
    assert num_parameters(params["params"]["head"]) == head == 1_107_974
    assert num_parameters(params) == trunk + head
    assert jax.eval_shape(actor.apply, params, representation).shape == (2, 6)


class TrunkTest(chex.TestCase):
    def test_is_linear_then_layer_norm_then_tanh(self):
        trunk = Trunk(feature_dim=5)
        # Small inputs: their variance is near epsilon, so epsilon is seen.
        x = 0.003 * np.random.default_rng(0).normal(size=(4, 7)).astype(np.float32)
        params = trunk.init(jax.random.key(0), x)
        rng = np.random.default_rng(1)
        params = jax.tree.map(
            lambda leaf: leaf + 0.1 * rng.normal(size=leaf.shape), params
        )
        layers = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
        project, norm = layers["params"]["project"], layers["params"]["normalise"]
        # A bias would swamp the small inputs: the same for all features, it cancels.
        project["bias"] = np.full(5, 0.1)
        params["params"]["project"]["bias"] = jnp.full(5, 0.1)
        y = x @ project["kernel"] + project["bias"]

        def by_hand(epsilon):
            centred = y - y.mean(axis=1, keepdims=True)
            scaled = centred / np.sqrt(y.var(axis=1, keepdims=True) + epsilon)
            return np.tanh(scaled * norm["scale"] + norm["bias"])

        features = jax.jit(trunk.apply)(params, x)
        np.testing.assert_allclose(features, by_hand(1e-5), atol=1e-4)
        assert np.abs(by_hand(1e-5) - by_hand(1e-6)).max() > 1e-2


class ActorTest(chex.TestCase):
    def test_head_is_two_relu_layers_and_a_linear_one(self):
        mlp = MLP(hidden_dim=6, output_dim=3)
        x = np.random.default_rng(0).normal(size=(4, 5)).astype(np.float32)
        params = mlp.init(jax.random.key(0), x)
        params = jax.tree.map(lambda leaf: leaf + 0.1, params)
        y = x
        for name in ("hidden_1", "hidden_2"):
            layer = params["params"][name]
            y = np.maximum(y @ layer["kernel"] + layer["bias"][None], 0.0)
        layer = params["params"]["output"]
        expected = y @ layer["kernel"] + layer["bias"][None]
        assert expected.min() < 0.0  # no ReLU at the end
        np.testing.assert_allclose(jax.jit(mlp.apply)(params, x), expected, atol=1e-5)

    def test_acts_on_its_own_features(self):
        actor = Actor(action_dim=2, feature_dim=5, hidden_dim=6)
        representation = jax.random.normal(jax.random.key(0), (3, 8))
        params = actor.init(jax.random.key(1), representation)
        features = apply(actor, params, representation, method=actor.features)
        assert features.shape == (3, 5)
        head = MLP(6, 2)
        expected = apply(head, {"params": params["params"]["head"]}, features)
        np.testing.assert_allclose(
            apply(actor, params, representation), expected, atol=1e-6
        )


def test_dense_layers_start_orthogonal_with_bias_zero():
    actor = Actor(action_dim=3, feature_dim=5, hidden_dim=16)
    params = actor.init(jax.random.key(0), jnp.zeros((1, 20)))["params"]
    layers = [params["trunk"]["project"], *params["head"].values()]
    assert len(layers) == 4
    for layer in layers:
        assert_orthogonal(layer["kernel"])
        np.testing.assert_array_equal(layer["bias"], np.zeros_like(layer["bias"]))
    norm = params["trunk"]["normalise"]
    np.testing.assert_array_equal(norm["scale"], np.ones(5))
    np.testing.assert_array_equal(norm["bias"], np.zeros(5))


def test_actor_features_are_the_trunk_on_the_encoder():
    images = np.random.default_rng(0).integers(0, 256, (3, 12, 12, 3), dtype=np.uint8)
    encoder = NETWORKS.encoder.init(jax.random.key(0), images)
    representation = apply(NETWORKS.encoder, encoder, images)
    actor = NETWORKS.actor.init(jax.random.key(1), representation)
    trunk = apply(Trunk(5), {"params": actor["params"]["trunk"]}, representation)
    features = actor_features(NETWORKS, encoder, actor, jnp.asarray(images))
    np.testing.assert_allclose(features, trunk, atol=1e-6)
