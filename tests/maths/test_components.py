"""Principal components in parts: against a decomposition of all rows at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.maths import components

merge = jax.jit(components.merge)


def random_rows(seed, num, rank, width=12):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(num, rank)) @ rng.normal(size=(rank, width))
    return rows.astype(np.float32)


def energy(rows):
    return np.asarray(rows).T @ np.asarray(rows)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), rank=st.integers(1, 4))
def test_is_exact_while_the_rows_have_its_rank(seed, rank):
    first, second = random_rows(seed, 14, rank).reshape(2, 7, 12)
    sketch = merge(merge(np.zeros((4, 12), np.float32), first), second)
    whole = energy(np.concatenate([first, second]))
    np.testing.assert_allclose(
        energy(sketch), whole, atol=1e-4 * np.abs(whole).max() + 1e-6
    )


def test_keeps_the_largest_directions_of_all_rows():
    rows = random_rows(0, 30, 12)
    _, lengths, directions = np.linalg.svd(rows, full_matrices=False)
    sketch = np.asarray(merge(np.zeros((3, 12), np.float32), rows))
    np.testing.assert_allclose(np.linalg.norm(sketch, axis=1), lengths[:3], rtol=1e-4)
    cosines = np.sum(sketch * directions[:3], axis=1) / lengths[:3]
    np.testing.assert_allclose(np.abs(cosines), 1.0, atol=1e-4)


def test_what_it_drops_is_lost_and_nothing_is_added():
    first, second = random_rows(1, 20, 12), random_rows(2, 20, 12)
    sketch = merge(merge(np.zeros((3, 12), np.float32), first), second)
    missing = energy(np.concatenate([first, second])) - energy(sketch)
    assert np.linalg.eigvalsh(missing).min() > -1e-3


def test_coordinates_are_along_directions_of_length_one():
    sketch = jnp.diag(jnp.asarray([3.0, 0.5, 0.0]))[:, jnp.asarray([2, 0, 1])]
    rows = jnp.asarray([[1.0, 2.0, 7.0]])
    # By hand: the directions are the columns 1, 2 and none.
    np.testing.assert_allclose(components.project(rows, sketch), [[2.0, 7.0, 0.0]])


@pytest.mark.parametrize("rank", [1, 2, 5])
def test_there_are_no_coordinates_beyond_the_rank_of_the_rows(rank):
    rows = 10.0 * random_rows(rank, 60, rank, 400)
    sketch = jnp.zeros((8, 400))
    for part in np.split(rows, 3):
        sketch = merge(sketch, part)
    coordinates = components.project(jnp.asarray(rows), sketch)
    # A rotation of the rows: nothing is lost, and what is left is zero.
    np.testing.assert_allclose(
        np.linalg.norm(coordinates, axis=1), np.linalg.norm(rows, axis=1), rtol=1e-3
    )
    np.testing.assert_array_equal(coordinates[:, rank:], 0.0)


@pytest.mark.parametrize("rows", [(4,), (4, 5)])
def test_rejects_rows_of_another_shape(rows):
    with pytest.raises(AssertionError):
        components.merge(jnp.zeros((2, 6)), jnp.zeros(rows))
