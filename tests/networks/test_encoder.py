"""The encoder at the paper's size, and its arithmetic on tiny images."""

import math
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized
from jax import lax

from jaxil.native import build
from jaxil.networks.agent import apply
from jaxil.networks.encoder import PixelEncoder, StateEncoder
from jaxil.networks.layers import Trunk

TINY = PixelEncoder(channels=(4, 4), kernel_sizes=(3, 3), strides=(2, 1))


def num_parameters(tree):
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def random_images(shape=(2, 12, 12, 3), seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


class PaperSizeTest(chex.TestCase):
    def test_39200_features_and_30368_parameters(self):
        encoder = PixelEncoder()
        images = jax.ShapeDtypeStruct((5, 84, 84, 9), jnp.uint8)
        params = jax.eval_shape(encoder.init, jax.random.key(0), images)
        # 3 * 3 * 9 * 32 + 32, then three times 3 * 3 * 32 * 32 + 32
        assert num_parameters(params) == 2_624 + 3 * 9_248 == 30_368
        features = jax.eval_shape(encoder.apply, params, images)
        assert features.shape == (5, 39_200)
        assert features.dtype == jnp.float32
        assert 39_200 == 32 * 35 * 35

    @parameterized.parameters(
        (84, (3, 3, 3, 3), (2, 1, 1, 1), 35),
        (12, (3, 3), (2, 1), 3),
        (8, (4,), (4,), 2),
    )
    def test_sides_shrink_by_kernel_and_stride(
        self, side, kernel_sizes, strides, expected
    ):
        encoder = PixelEncoder((2,) * len(strides), kernel_sizes, strides)
        images = jax.ShapeDtypeStruct((1, side, side, 3), jnp.uint8)
        params = jax.eval_shape(encoder.init, jax.random.key(0), images)
        features = jax.eval_shape(encoder.apply, params, images)
        assert features.shape == (1, 2 * expected**2)


class ArithmeticTest(chex.TestCase):
    def test_is_the_plain_chain_of_convolutions(self):
        images = random_images()
        params = TINY.init(jax.random.key(0), images)
        # Biases that are not zero, or leaving them out would go unseen.
        params = jax.tree.map(lambda leaf: leaf + 0.1, params)
        x = images.astype(np.float32) / 255.0 - 0.5
        for name, stride in (("Conv_0", 2), ("Conv_1", 1)):
            layer = params["params"][name]
            x = lax.conv_general_dilated(
                x,
                layer["kernel"],
                (stride, stride),
                "VALID",
                dimension_numbers=("NHWC", "HWIO", "NHWC"),
            )
            x = jnp.maximum(x + layer["bias"][None, None, None], 0.0)
        features = jax.jit(TINY.apply)(params, images)
        np.testing.assert_allclose(features, x.reshape(2, -1), atol=1e-5)

    @parameterized.parameters((1.0, 0.5), (4.0, 0.25))
    def test_pixels_are_centred_and_scaled(self, contrast, mean):
        # A 1 x 1 convolution with an identity kernel shows its input.
        encoder = PixelEncoder((3,), (1,), (1,), contrast, mean)
        params = {"params": {"Conv_0": {"kernel": jnp.eye(3)[None, None]}}}
        params["params"]["Conv_0"]["bias"] = jnp.full(3, 5.0)  # keeps ReLU open
        images = random_images()
        expected = contrast * (images / 255.0 - mean) + 5.0
        np.testing.assert_allclose(
            apply(encoder, params, images), expected.reshape(2, -1), atol=1e-5
        )

    def test_a_mean_image_is_subtracted_pixel_by_pixel(self):
        images = random_images((1, 12, 12, 3))
        own_mean = images[0] / np.float32(255.0)
        encoder = PixelEncoder((4, 4), (3, 3), (2, 1), 1.0, own_mean)
        params = TINY.init(jax.random.key(0), images)
        two = np.concatenate([images, random_images((1, 12, 12, 3), seed=1)])
        features = np.asarray(apply(encoder, params, two))
        # Its own mean leaves nothing of the first image; the second is still there.
        np.testing.assert_allclose(features[0], 0.0, atol=1e-6)
        assert features[1].max() > 0.1

    def test_images_do_not_see_each_other(self):
        images = random_images((3, 12, 12, 3))
        params = TINY.init(jax.random.key(0), images)
        alone = apply(TINY, params, images[1:2])
        np.testing.assert_allclose(apply(TINY, params, images)[1:2], alone, atol=1e-6)


def test_kernels_are_orthogonal_with_gain_root_two_and_biases_zero():
    encoder = PixelEncoder((8, 8), (3, 3), (2, 1))
    params = encoder.init(jax.random.key(0), random_images())["params"]
    for layer in params.values():
        kernel = np.asarray(layer["kernel"]).reshape(-1, 8)
        np.testing.assert_allclose(kernel.T @ kernel, 2.0 * np.eye(8), atol=1e-5)
        np.testing.assert_array_equal(layer["bias"], np.zeros(8))


def test_a_state_vectors_scale_reaches_the_trunk():
    # Two states that differ in nothing but scale: straight into the trunk, its
    # LayerNorm would make them one.
    encoder, trunk = StateEncoder(16), Trunk(8)
    state = jnp.array([[0.5, -3.0, 12.0]])
    states = jnp.concatenate([state, 2.0 * state, 0.0 * state])
    params = encoder.init(jax.random.key(0), states)
    representation = apply(encoder, params, states)
    chex.assert_shape(representation, (3, 16))
    assert np.min(np.asarray(representation)) >= 0.0
    trunk_params = trunk.init(jax.random.key(1), states)
    bare = np.asarray(apply(trunk, trunk_params, states))
    np.testing.assert_allclose(bare[0], bare[1], atol=1e-3)
    params = jax.tree.map(lambda x: x + 0.1, params)  # biases are no longer zero
    representation = apply(encoder, params, states)
    trunk_params = trunk.init(jax.random.key(1), representation)
    features = np.asarray(apply(trunk, trunk_params, representation))
    assert np.abs(features[0] - features[1]).max() > 0.05


def test_an_image_without_batch_is_rejected():
    with pytest.raises(AssertionError):
        TINY.init(jax.random.key(0), random_images()[0])


def test_bfloat16_computes_in_halves_and_keeps_float32():
    images = random_images()
    half = PixelEncoder((4, 4), (3, 3), (2, 1), dtype=jnp.bfloat16)
    params = half.init(jax.random.key(0), images)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}
    features, expected = apply(half, params, images), apply(TINY, params, images)
    assert features.dtype == jnp.bfloat16
    # Eight bits of mantissa, through two layers; some rounding must show.
    error = np.abs(np.asarray(features, np.float32) - expected)
    assert 0.0 < error.max() < 0.03 * np.abs(expected).max()
    trunk = Trunk(8, jnp.bfloat16)
    trunk_params = trunk.init(jax.random.key(1), features)
    squeezed = apply(trunk, trunk_params, features)
    assert squeezed.dtype == jnp.float32
    plain = apply(Trunk(8), trunk_params, expected)
    assert 0.0 < np.abs(squeezed - plain).max() < 0.1
    gradient = jax.grad(lambda p: apply(half, p, images).astype(jnp.float32).sum())
    exact = jax.grad(lambda p: apply(TINY, p, images).sum())
    for ours, theirs in zip(
        jax.tree.leaves(gradient(params)), jax.tree.leaves(exact(params)), strict=True
    ):
        assert ours.dtype == jnp.float32
        assert np.abs(ours - theirs).max() < 0.05 * np.abs(theirs).max()


class NativeTest(chex.TestCase):
    def test_native_convolutions_change_neither_value_nor_gradients(self):
        assert build.problem() is None
        plain = PixelEncoder((32, 64), (3, 3), (2, 1))
        images = random_images((5, 12, 12, 3))
        params = plain.init(jax.random.key(0), images)
        cotangent = jnp.sin(jnp.arange(5 * 576.0)).reshape(5, 576)

        def both(encoder, params):
            def weighted(params):
                representation = apply(encoder, params, images)
                return jnp.sum(representation * cotangent), representation

            return jax.grad(weighted, has_aux=True)(params)

        run: Any = jax.jit(lambda p: both(plain.clone(native=True), p))
        chex.assert_trees_all_close(
            run(params), both(plain, params), rtol=1e-4, atol=1e-4
        )


def test_parameters_are_those_of_flaxs_convolutions():
    # Earlier runs used flax's layer: their checkpoints and seeds stay valid.
    class Flaxs(nn.Module):
        @nn.compact
        def __call__(self, x):
            for features, stride in ((4, 2), (5, 1)):
                x = nn.Conv(
                    features,
                    (3, 3),
                    (stride, stride),
                    "VALID",
                    kernel_init=nn.initializers.orthogonal(scale=math.sqrt(2.0)),
                )(x)
            return x

    encoder = PixelEncoder((4, 5), (3, 3), (2, 1))
    ours = encoder.init(jax.random.key(3), random_images())
    theirs = Flaxs().init(jax.random.key(3), jnp.zeros((2, 12, 12, 3)))
    chex.assert_trees_all_equal(ours, theirs)
