"""The matrix product of dense layers, with gradients that are fast on CPUs.

XLA passes matrices to Eigen in their memory layout. A product that reads one of them
across its rows takes twice as long on one core: 256x1024 times a transposed 1024x1024
takes 5.6 ms instead of 2.2, the gradient of a 39200x50 kernel 10.6 instead of 5.3. So
operands are swapped or transposed here first, and barriers keep XLA from undoing it.
On other devices this costs small copies.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import Array, lax

# Kernels at least this many times longer than wide are read in the other order.
_SLENDER = 16
# For the gradient of those kernels, x is transposed if it has at most this many
# elements, which fit in the caches.
_SMALL = 2**20


def product(x: Array, kernel: Array) -> Array:
    """Returns x W of x [B, R] and W [R, F]; differentiable any number of times."""
    chex.assert_rank([x, kernel], 2)
    return _PRODUCT(x, kernel)


def dot_general(x: Array, kernel: Array, *_: Any, **__: Any) -> Array:
    """Computes `product` with the signature that `flax.linen.Dense` calls."""
    return product(x, kernel)


def _is_slender(kernel: Array) -> bool:
    return kernel.shape[0] >= _SLENDER * kernel.shape[1]


def _product(x: Array, kernel: Array) -> Array:
    return jnp.matmul(x, kernel)


def _transposed_product(y: Array, kernel: Array) -> Array:
    """Returns y W'."""
    if _is_slender(kernel):
        return jnp.matmul(y, kernel.T)
    barrier = lax.optimization_barrier
    return barrier(jnp.matmul(kernel, barrier(y.T))).T


def _outer_product(x: Array, y: Array) -> Array:
    """Returns x' y, the gradient of a kernel."""
    if x.shape[1] < _SLENDER * y.shape[1]:
        return jnp.matmul(x.T, y)
    if x.size <= _SMALL:
        return jnp.matmul(lax.optimization_barrier(x.T), y)
    return lax.optimization_barrier(jnp.matmul(y.T, x)).T


def _forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return _product(x, kernel), (x, kernel)


def _backward(saved: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, kernel = saved
    return _TRANSPOSED(cotangent, kernel), _outer_product(x, cotangent)


def _transposed_forward(y: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return _transposed_product(y, kernel), (y, kernel)


def _transposed_backward(
    saved: tuple[Array, Array], cotangent: Array
) -> tuple[Array, Array]:
    y, kernel = saved
    return _PRODUCT(cotangent, kernel), _outer_product(cotangent, y)


_PRODUCT: Any = jax.custom_vjp(_product)
_PRODUCT.defvjp(_forward, _backward)
_TRANSPOSED: Any = jax.custom_vjp(_transposed_product)
_TRANSPOSED.defvjp(_transposed_forward, _transposed_backward)
