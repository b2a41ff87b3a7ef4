"""Both forms of the convolution against XLA's own, in value and gradients."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from jaxil.maths import convolution

FORMS = convolution.convolve, convolution.convolve_by_windows


def reference(images, kernel, stride):
    """The sum over every window, by another function that cuts them out."""
    height, width, _, features = kernel.shape
    windows = lax.conv_general_dilated_patches(
        images,
        (height, width),
        (stride, stride),
        "VALID",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    matrix = kernel.transpose(2, 0, 1, 3).reshape(-1, features)
    return jnp.einsum("bijn,nf->bijf", windows, matrix)


def draw(seed, images_shape, kernel_shape):
    """Returns images and kernel, both normal."""
    rng = np.random.default_rng(seed)
    return tuple(
        jnp.asarray(rng.normal(size=shape), jnp.float32)
        for shape in (images_shape, kernel_shape)
    )


def value_and_gradients(convolve, arguments, stride):
    value, transpose = jax.vjp(lambda *x: convolve(*x, stride), *arguments)
    # Any cotangent will do that differs from place to place.
    places = jnp.arange(value.size, dtype=jnp.float32).reshape(value.shape)
    return (value, *transpose(jnp.sin(17.0 * places)))


def assert_same(arguments, stride):
    expected = value_and_gradients(reference, arguments, stride)
    for form in FORMS:
        run = jax.jit(lambda *x, f=form: value_and_gradients(f, x, stride))
        for ours_, theirs in zip(run(*arguments), expected, strict=True):
            assert ours_.shape == theirs.shape
            scale = float(jnp.max(jnp.abs(theirs))) + 1e-3
            np.testing.assert_allclose(ours_ / scale, theirs / scale, atol=2e-5)


@pytest.mark.parametrize(
    ("size", "stride"),
    [(3, 1), (3, 2), (3, 4), (4, 4), (2, 2), (8, 4), (1, 1), (1, 2)],
)
def test_value_and_gradients(size, stride):
    assert_same(draw(0, (2, 13, 13, 3), (size, size, 3, 5)), stride)


@pytest.mark.parametrize(("size", "stride"), [(4, 4), (3, 1), (3, 2)])
def test_gradients_of_gradients(size, stride):
    # As a gradient penalty on pixels needs them; windows of 4 leave some pixels unused.
    arguments = draw(1, (2, 14, 14, 3), (size, size, 3, 5))

    def penalty(convolve):
        def slope(images, kernel):
            gradient = jax.grad(
                lambda x: jnp.sum(jnp.sin(convolve(x, kernel, stride)))
            )(images)
            return jnp.sum(jnp.square(gradient))

        return jax.jit(jax.grad(slope, argnums=(0, 1)))(*arguments)

    expected = penalty(reference)
    for form in FORMS:
        chex.assert_trees_all_close(penalty(form), expected, rtol=1e-4, atol=2e-3)


def test_by_windows_needs_no_convolution_on_a_cpu():
    # What it is for: gradients of XLA's convolution's gradient are slow there.
    arguments = draw(1, (2, 14, 14, 3), (3, 3, 3, 5))
    compiled = [
        jax.jit(lambda *x, f=form: f(*x, 1)).lower(*arguments).compile().as_text()
        for form in FORMS
    ]
    assert ["convolution(" in str(text) for text in compiled] == [True, False]


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


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_not_hidden(form, value):
    # Of three images the second has one such pixel; its windows show it, no others.
    images, kernel = draw(5, (3, 5, 6, 2), (3, 3, 2, 4))
    y = np.asarray(form(images.at[1, 2, 3, 0].set(value), kernel, 1))
    seen = np.zeros(y.shape, bool)
    seen[1, 0:3, 1:4] = True
    np.testing.assert_array_equal(~np.isfinite(y), seen)
    np.testing.assert_array_equal(np.isnan(y), seen & np.isnan(value))


@pytest.mark.parametrize("form", FORMS)
def test_rejects_an_image_without_batch(form):
    image, kernel = draw(0, (9, 9, 2), (3, 3, 2, 4))
    with pytest.raises(AssertionError):
        form(image, kernel, 2)
