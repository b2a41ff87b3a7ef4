"""Shifts against their plain definition, and against DrQ-v2's own."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized

from jaxil.maths import augmentation


def probe_images(batch, height, width, channels):
    """Images whose every pixel says where it is, the same in all images."""
    image = np.arange(height * width * channels, dtype=np.float32)
    image = image.reshape(height, width, channels)
    return jnp.asarray(np.broadcast_to(image, (batch, height, width, channels)))


def crop(image, corner, padding):
    """The definition: repeat the border, then cut out the image's own size."""
    height, width, _ = image.shape
    padded = np.pad(image, ((padding, padding), (padding, padding), (0, 0)), "edge")
    row, column = corner
    return padded[row : row + height, column : column + width]


def corners_of(key, batch, padding, side=8):
    """Reads the corners that `random_shift` sampled from images that encode them."""
    images = probe_images(batch, side, side, 1)
    shifted = np.asarray(augmentation.random_shift(images, key, padding=padding))
    candidates = {
        crop(images[0], (row, column), padding).tobytes(): (row, column)
        for row in range(2 * padding + 1)
        for column in range(2 * padding + 1)
    }
    assert len(candidates) == (2 * padding + 1) ** 2
    return np.array([candidates[image.tobytes()] for image in shifted])


def bilinear_shift(images, corners, padding):
    """DrQ-v2's augmentation: bilinear samples on a shifted grid, in float32.

    The grid lives in [-1, 1] over the padded image, whose pixel p of S has its
    centre at (2 p + 1) / S - 1, as in PyTorch's grid_sample(align_corners=False).
    """
    batch, side, _, channels = images.shape
    padded_side = side + 2 * padding
    margin = np.float32(1.0 / padded_side)
    grid = np.linspace(-1 + margin, 1 - margin, padded_side, dtype=np.float32)[:side]
    out = np.zeros((batch, side, side, channels), np.float32)
    for b in range(batch):
        padded = np.pad(
            images[b], ((padding, padding), (padding, padding), (0, 0)), "edge"
        )
        step = np.float32(2.0 / padded_side)
        rows, columns = (grid + np.float32(corner) * step for corner in corners[b])
        y = ((rows + 1) * padded_side - 1) / 2
        x = ((columns + 1) * padded_side - 1) / 2
        for dy in (0, 1):
            for dx in (0, 1):
                row, column = np.floor(y) + dy, np.floor(x) + dx
                weight = np.outer(1 - np.abs(y - row), 1 - np.abs(x - column))
                inside = np.outer(
                    (row >= 0) & (row < padded_side),
                    (column >= 0) & (column < padded_side),
                )
                row = np.clip(row, 0, padded_side - 1).astype(int)
                column = np.clip(column, 0, padded_side - 1).astype(int)
                values = padded[row][:, column]
                out[b] += (weight * inside)[..., None] * values
    return out


class RandomShiftTest(chex.TestCase):
    @parameterized.parameters(1, 4)
    def test_is_an_edge_padded_crop_with_all_channels_together(self, padding):
        key = jax.random.key(padding)
        rng = np.random.default_rng(padding)
        images = rng.integers(0, 256, (16, 8, 8, 9), dtype=np.uint8)
        shift = functools.partial(augmentation.random_shift, padding=padding)
        shifted = np.asarray(jax.jit(shift)(images, key))
        corners = corners_of(key, 16, padding)
        for image, corner, result in zip(images, corners, shifted):
            np.testing.assert_array_equal(result, crop(image, corner, padding))

    def test_is_what_bilinear_sampling_gives(self):
        key = jax.random.key(3)
        images = np.random.default_rng(3).uniform(0, 255, (6, 8, 8, 3))
        images = images.astype(np.float32)
        ours = augmentation.random_shift(jnp.asarray(images), key, padding=4)
        theirs = bilinear_shift(images, corners_of(key, 6, 4), 4)
        np.testing.assert_allclose(ours, theirs, atol=2e-3)  # of 255

    def test_corners_are_independent_and_uniform(self):
        counts = np.zeros((5, 5))
        np.add.at(counts, tuple(corners_of(jax.random.key(0), 2500, 2).T), 1)
        # 100 expected in each of 25 cells; 24 degrees of freedom: 51.2 is the
        # 99.9 % point of chi-squared.
        assert np.sum((counts - 100.0) ** 2 / 100.0) < 51.2

    def test_height_and_width_are_not_swapped(self):
        images = probe_images(32, 5, 9, 2)
        key = jax.random.key(7)
        shifted = np.asarray(augmentation.random_shift(images, key, padding=1))
        for image, result in zip(images, shifted):
            matches = [
                np.array_equal(result, crop(image, (row, column), 1))
                for row in range(3)
                for column in range(3)
            ]
            assert sum(matches) == 1

    def test_no_padding_is_the_identity(self):
        images = probe_images(3, 4, 4, 2)
        shifted = augmentation.random_shift(images, jax.random.key(0), padding=0)
        np.testing.assert_array_equal(shifted, images)

    def test_rejects_a_single_image(self):
        with pytest.raises(AssertionError):
            augmentation.random_shift(
                jnp.zeros((4, 4, 3)), jax.random.key(0), padding=1
            )


def test_a_pair_moves_as_one_and_states_stay():
    images = probe_images(6, 8, 8, 3)
    key = jax.random.key(0)
    first, second = augmentation.augment_pair(images, images, key, padding=2)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(
        first, augmentation.random_shift(images, key, padding=2)
    )
    states = jnp.arange(6.0).reshape(2, 3)
    for got in augmentation.augment_pair(states, states, key, padding=2):
        np.testing.assert_array_equal(got, states)
    with pytest.raises(AssertionError):
        augmentation.augment_pair(images, images[:3], key, padding=2)
