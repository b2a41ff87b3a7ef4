"""Principal components of rows that arrive in batches."""

import chex
import jax.numpy as jnp
from jax import Array, lax

# Shorter directions, relative to the longest, are float32's rounding.
_NEGLIGIBLE = 1e-5


def merge(sketch: Array, rows: Array) -> Array:
    """Adds rows to a sketch of those before them.

        S'^T S' = the best rank-J approximation of S^T S + X^T X

    S' = U^T [S; X] = L V^T, with U and L^2 the first J eigenvectors and eigenvalues of
    [S; X] [S; X]^T, which is small where rows are few and long. Exact as long as all
    rows so far have at most rank J.

    Args:
      sketch: S, from the rows before; zeros at first. Shape [J, P].
      rows: X, less their mean. Shape [M, P].

    Returns:
      S': principal directions, the largest first; the length of each is the root of
      the rows' sum of squares along it. Shape [J, P].

    Source: merge-and-truncate, Ross et al. 2008, Incremental learning for robust
    visual tracking, sec. 3.1, with a fixed mean.
    """
    chex.assert_rank([sketch, rows], 2)
    chex.assert_equal_shape_suffix([sketch, rows], 1)
    together = jnp.concatenate([sketch, rows])
    gram = jnp.matmul(together, together.T, precision=lax.Precision.HIGHEST)
    _, vectors = jnp.linalg.eigh(gram)  # smallest first
    largest = vectors[:, ::-1][:, : len(sketch)]
    return jnp.matmul(largest.T, together, precision=lax.Precision.HIGHEST)


def project(rows: Array, sketch: Array) -> Array:
    """Returns coordinates along the sketch's directions: [M, P], [J, P] to [M, J].

    Zero along directions that the rows so far do not have.
    """
    chex.assert_rank([rows, sketch], 2)
    chex.assert_equal_shape_suffix([rows, sketch], 1)
    lengths = jnp.linalg.norm(sketch, axis=1, keepdims=True)
    is_one = lengths > _NEGLIGIBLE * jnp.max(lengths)
    directions = jnp.where(is_one, sketch / jnp.where(is_one, lengths, 1.0), 0.0)
    return rows @ directions.T
