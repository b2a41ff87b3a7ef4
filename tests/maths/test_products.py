"""Dense layers' product against the plain one, in value and all derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.maths import products


def draw(batch, rows, features):
    rng = np.random.default_rng(0)
    return (
        jnp.asarray(rng.normal(size=(batch, rows)), jnp.float32),
        jnp.asarray(rng.normal(size=(rows, features)), jnp.float32),
    )


def weighted(form, x, kernel):
    y = form(x, kernel)
    places = jnp.arange(y.size, dtype=jnp.float32).reshape(y.shape)
    return jnp.sum(jnp.sin(places) * jnp.tanh(y))


def penalty(form, x, kernel):
    """As a gradient penalty takes a second derivative."""
    slopes = jax.grad(functools.partial(weighted, form))(x, kernel)
    return jnp.sum(jnp.square(slopes))


# 16 rows for each feature is where the form changes.
@pytest.mark.parametrize(
    ("batch", "rows", "features"), [(9, 15, 1), (1, 16, 1), (8, 31, 2), (3, 32, 2)]
)
def test_values_and_two_derivatives(batch, rows, features):
    x, kernel = draw(batch, rows, features)
    np.testing.assert_array_equal(products.product(x, kernel), x @ kernel)
    for function in (weighted, penalty):
        ours, plain = (
            jax.jit(jax.grad(functools.partial(function, form), argnums=(0, 1)))(
                x, kernel
            )
            for form in (products.product, jnp.matmul)
        )
        for mine, other in zip(ours, plain, strict=True):
            np.testing.assert_allclose(mine, other, rtol=1e-4, atol=1e-4)


def test_a_kernels_gradient_by_hand():
    x, kernel = jnp.asarray([[1.0, 2.0]]), jnp.asarray([[3.0], [4.0]])
    y, transpose = jax.vjp(products.product, x, kernel)
    assert y == 11.0
    to_x, to_kernel = transpose(jnp.asarray([[10.0]]))
    np.testing.assert_array_equal(to_x, [[30.0, 40.0]])
    np.testing.assert_array_equal(to_kernel, [[10.0], [20.0]])


def test_rows_may_be_vmapped():
    x, kernel = draw(6, 20, 3)
    rows = jax.vmap(lambda row: products.product(row[None], kernel)[0])(x)
    np.testing.assert_allclose(rows, x @ kernel, rtol=1e-5, atol=1e-5)


def test_rejects_another_rank():
    x, kernel = draw(6, 20, 3)
    with pytest.raises(AssertionError):
        products.product(x[0], kernel)
