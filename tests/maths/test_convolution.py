"""Our convolution against XLA's own, in value, gradient and gradient of gradient."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from jaxil.maths import convolution

with_and_without_jit: Any = chex.variants(with_jit=True, without_jit=True)

LAYOUT = ("NHWC", "HWIO", "NHWC")


def reference(images, kernel, strides):
    return lax.conv_general_dilated(
        images, kernel, strides, "VALID", dimension_numbers=LAYOUT
    )


def ours(images, kernel, strides):
    # flax hands over dimension numbers as jax has parsed them.
    numbers = lax.conv_dimension_numbers(images.shape, kernel.shape, LAYOUT)
    return convolution.convolve(
        images,
        kernel,
        strides,
        "VALID",
        dimension_numbers=numbers,
        saves_memory=kernel.shape[0] % 2 == 1,  # of the sizes below, both kinds
    )


def draw(seed, images_shape, kernel_shape):
    rng = np.random.default_rng(seed)
    return tuple(
        jnp.asarray(rng.normal(size=shape), jnp.float32)
        for shape in (images_shape, kernel_shape)
    )


def assert_same(images, kernel, strides):
    @jax.jit
    def both(images, kernel):
        results = []
        for convolve in (ours, reference):
            value, transpose = jax.vjp(
                lambda x, w, f=convolve: f(x, w, strides), images, kernel
            )
            # Any cotangent will do that differs from place to place.
            results.append((value, *transpose(jnp.sin(17.0 * value))))
        return results

    for result, expected in zip(*both(images, kernel), strict=True):
        assert result.shape == expected.shape
        np.testing.assert_allclose(result, expected, atol=1e-3)


class ConvolveTest(chex.TestCase):
    @with_and_without_jit
    @parameterized.parameters(
        (3, 1), (3, 2), (3, 4), (4, 4), (2, 2), (8, 4), (1, 1), (1, 2)
    )
    def test_equals_xla(self, size, stride):
        images, kernel = draw(0, (2, 13, 13, 3), (size, size, 3, 5))
        strides = (stride, stride)
        value = self.variant(lambda x, w: ours(x, w, strides))(images, kernel)
        np.testing.assert_allclose(value, reference(images, kernel, strides), atol=1e-4)

    def test_tile_gradient_by_hand(self):
        # Windows of 2 see every pixel but a last, odd one.
        kernel = jnp.asarray([1.0, 10.0]).reshape(1, 2, 1, 1)
        cotangent = jnp.asarray([1.0, 2.0]).reshape(1, 1, 2, 1)
        gradient = convolution.tile_gradient(cotangent, kernel, (1, 5))
        np.testing.assert_array_equal(gradient.reshape(-1), [1, 10, 2, 20, 0])

    def test_gradients_of_gradients_equal_xla(self):
        # As a gradient penalty on pixels needs them; 14 pixels leave some unused.
        images, kernel = draw(1, (2, 14, 14, 3), (4, 4, 3, 5))

        def penalty(convolve):
            def slope(x, w):
                gradient = jax.grad(lambda x: jnp.sum(jnp.sin(convolve(x, w, (4, 4)))))(
                    x
                )
                return jnp.sum(jnp.square(gradient))

            return jax.grad(slope, argnums=(0, 1))(images, kernel)

        chex.assert_trees_all_close(
            penalty(ours), penalty(reference), rtol=1e-4, atol=2e-3
        )


@settings(derandomize=True, max_examples=12, deadline=None)
@given(data=st.data())
def test_value_and_gradients_at_any_size(data):
    stride = data.draw(st.sampled_from([1, 2, 4]), "stride")
    kernel = data.draw(st.tuples(st.integers(1, 5), st.integers(1, 5)), "kernel")
    size = [side + data.draw(st.integers(0, 7)) for side in kernel]
    channels, features = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 3))
    images, weights = draw(stride, (2, *size, channels), (*kernel, channels, features))
    assert_same(images, weights, (stride, stride))


@settings(derandomize=True, max_examples=6, deadline=None)
@given(
    stride=st.sampled_from([2, 3, 4]),
    height=st.integers(4, 11),
    width=st.integers(4, 11),
)
def test_windows_that_do_not_overlap(stride, height, width):
    images, kernel = draw(0, (2, height, width, 2), (stride, stride, 2, 3))
    assert_same(images, kernel, (stride, stride))


def test_strides_may_differ():
    images, kernel = draw(0, (2, 9, 10, 2), (3, 2, 2, 4))
    assert_same(images, kernel, (1, 2))
    assert_same(images, kernel, (3, 2))


def test_rejects_an_image_without_batch():
    image, kernel = draw(0, (9, 9, 2), (3, 3, 2, 4))
    with pytest.raises(AssertionError):
        convolution.convolve(image, kernel, (2, 2), "VALID")


@pytest.mark.parametrize(
    ("padding", "settings"),
    [
        ("SAME", {}),
        ([(1, 0), (0, 1)], {}),
        ("VALID", {"rhs_dilation": (2, 2)}),
        ([(0, 0), (0, 0)], {"lhs_dilation": (1, 2)}),
        ("VALID", {"feature_group_count": 2}),
        ("VALID", {"precision": "highest"}),
        ("VALID", {"dimension_numbers": ("NWHC", "HWIO", "NHWC")}),
    ],
)
def test_other_convolutions_are_xlas(padding, settings):
    channels = 2 * settings.get("feature_group_count", 1)
    images, kernel = draw(0, (2, 10, 9, channels), (2, 2, 2, 4))
    settings = {"dimension_numbers": LAYOUT, **settings}

    def both(convolve):
        def convolved(images, kernel):
            return convolve(images, kernel, (2, 2), padding, **settings)

        value, transpose = jax.vjp(convolved, images, kernel)
        return value, transpose(jnp.sin(17.0 * value))

    chex.assert_trees_all_close(
        both(convolution.convolve), both(lax.conv_general_dilated), atol=1e-5
    )
