"""Our convolution against XLA's own, in value and gradients."""

import functools

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


def reference(images, kernel, bias, stride):
    z = lax.conv_general_dilated(
        images,
        kernel,
        (stride, stride),
        "VALID",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return jnp.maximum(z + bias[None, None, None], 0.0)


def draw(seed, images_shape, kernel_shape):
    """Returns images, kernel and bias, all normal."""
    rng = np.random.default_rng(seed)
    return tuple(
        jnp.asarray(rng.normal(size=shape), jnp.float32)
        for shape in (images_shape, kernel_shape, kernel_shape[3:])
    )


def value_and_gradients(convolve, arguments, stride):
    value, transpose = jax.vjp(lambda *x: convolve(*x, stride), *arguments)
    # Any cotangent will do that differs from place to place.
    places = jnp.arange(value.size, dtype=jnp.float32).reshape(value.shape)
    return (value, *transpose(jnp.sin(17.0 * places)))


def assert_same(arguments, stride):
    results, expected = (
        jax.jit(lambda *x, f=form: value_and_gradients(f, x, stride))(*arguments)
        for form in (convolution.convolve_relu, reference)
    )
    for ours_, theirs in zip(results, expected, strict=True):
        assert ours_.shape == theirs.shape
        scale = float(jnp.max(jnp.abs(theirs))) + 1e-3
        np.testing.assert_allclose(ours_ / scale, theirs / scale, atol=2e-5)


class ConvolveReluTest(chex.TestCase):
    @parameterized.parameters(
        (3, 1), (3, 2), (3, 4), (4, 4), (2, 2), (8, 4), (1, 1), (1, 2)
    )
    def test_equals_xla(self, size, stride):
        images, kernel, bias = draw(0, (2, 13, 13, 3), (size, size, 3, 5))
        run = jax.jit(functools.partial(convolution.convolve_relu, stride=stride))
        expected = reference(images, kernel, bias, stride)
        ours = run(images, kernel, bias)
        np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-4)

    def test_tile_gradient_by_hand(self):
        # Windows of 2 see every pixel but a last, odd one.
        kernel = jnp.asarray([1.0, 10.0]).reshape(1, 2, 1, 1)
        cotangent = jnp.asarray([1.0, 2.0]).reshape(1, 1, 2, 1)
        gradient = convolution.tile_gradient(cotangent, kernel, (1, 5))
        np.testing.assert_array_equal(gradient.reshape(-1), [1, 10, 2, 20, 0])

    def test_gradients_of_gradients_equal_xla(self):
        # As a gradient penalty on pixels needs them; 14 pixels leave some unused.
        arguments = draw(1, (2, 14, 14, 3), (4, 4, 3, 5))

        def penalty(convolve):
            def slope(images, *others):
                gradient = jax.grad(
                    lambda x: jnp.sum(jnp.sin(convolve(x, *others, 4)))
                )(images)
                return jnp.sum(jnp.square(gradient))

            return jax.jit(jax.grad(slope, argnums=(0, 1, 2)))(*arguments)

        chex.assert_trees_all_close(
            penalty(convolution.convolve_relu),
            penalty(reference),
            rtol=1e-4,
            atol=2e-3,
        )


@settings(derandomize=True, max_examples=6, deadline=None)
@given(data=st.data())
def test_value_and_gradients_at_any_size(data):
    stride = data.draw(st.sampled_from([1, 2, 4]), "stride")
    kernel = data.draw(st.tuples(st.integers(1, 5), st.integers(1, 5)), "kernel")
    size = [side + data.draw(st.integers(0, 20)) for side in kernel]
    channels = data.draw(st.sampled_from([1, 2, 9]), "channels")
    features = data.draw(st.sampled_from([1, 3, 32]), "features")
    batch = data.draw(st.integers(1, 5), "batch")
    arguments = draw(stride, (batch, *size, channels), (*kernel, channels, features))
    assert_same(arguments, stride)


@settings(derandomize=True, max_examples=3, deadline=None)
@given(
    stride=st.sampled_from([2, 3, 4]),
    height=st.integers(4, 11),
    width=st.integers(4, 11),
)
def test_windows_that_do_not_overlap(stride, height, width):
    arguments = draw(0, (2, height, width, 2), (stride, stride, 2, 3))
    assert_same(arguments, stride)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_not_hidden(value):
    # Of three images the second has one such pixel; its windows show it, no others.
    images, kernel, bias = draw(5, (3, 5, 6, 2), (3, 3, 2, 4))
    images = images.at[1, 2, 3, 0].set(value)
    run = jax.jit(functools.partial(convolution.convolve_relu, stride=1))
    y, expected = run(images, kernel, bias), reference(images, kernel, bias, 1)
    np.testing.assert_array_equal(np.isfinite(y), np.isfinite(expected))
    np.testing.assert_array_equal(np.isnan(y), np.isnan(expected))
    assert not np.isfinite(np.asarray(y[1])).all()
    assert np.isfinite(np.asarray(y)[::2]).all()


def test_rejects_an_image_without_batch():
    image, kernel, bias = draw(0, (9, 9, 2), (3, 3, 2, 4))
    with pytest.raises(AssertionError):
        convolution.convolve_relu(image, kernel, bias, 2)
