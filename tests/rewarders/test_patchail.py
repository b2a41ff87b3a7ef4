"""PatchAIL: its patches, their similarity by hand, and its three rewards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil.networks.discriminator import PatchDiscriminator
from jaxil.rewarders import patchail
from tests.tiny_agent import (
    NOBODY,
    make_agent,
    make_episode,
    make_spec,
    random_frames,
)


@pytest.mark.parametrize(("side", "patches"), [(84, 39**2), (48, 21**2), (8, 1)])
def test_patches_of_an_image(side, patches):
    # Padded by one: 84 pixels to 42, 41, 40, 39.
    pixels = jax.ShapeDtypeStruct((2, side, side, 18), jnp.float32)
    network = PatchDiscriminator(width=32)
    params = jax.eval_shape(network.init, jax.random.key(0), pixels)
    assert jax.eval_shape(network.apply, params, pixels).shape == (2, patches)
    layers = ((18, 32), (32, 64), (64, 128), (128, 1))
    count = sum(leaf.size for leaf in jax.tree.leaves(params))
    assert count == sum(16 * i * o + o for i, o in layers)


def test_a_patch_sees_22_pixels_and_is_2_from_the_next():
    network, pixels = PatchDiscriminator(width=1), np.full((1, 48, 48, 2), 0.5)
    pixels[0, 24, 27] = 1.0
    shapes = jax.eval_shape(network.init, jax.random.key(0), pixels)
    positive = jax.tree.map(lambda leaf: np.full(leaf.shape, leaf.ndim > 1), shapes)
    logits = jax.jit(network.apply)(positive, pixels)
    seen = np.asarray(logits).reshape(21, 21) != 0.0
    # Patch p is of rows 2 p - 7 to 2 p + 14.
    rows, columns = (set(places.tolist()) for places in np.nonzero(seen))
    assert rows == set(range(5, 16))
    assert columns == set(range(7, 18))


def test_similarity_by_hand():
    # D = 1/2, 1/2 and 1/4, 3/4. KL(1/2, 1/2 | 1/4, 3/4) = log(4/3) / 2.
    logits = jnp.array([[0.0, 0.0], [-np.log(3.0), np.log(3.0)]])
    similarity = jax.jit(patchail.patch_similarity)
    found = similarity(logits, jnp.array([0.25, 0.75]))
    np.testing.assert_allclose(found, [np.sqrt(0.75), 1.0], rtol=1e-5)
    large = similarity(1_000.0 * logits, jnp.array([0.5, 0.5]))
    np.testing.assert_allclose(large, [1.0, 0.5], rtol=1e-5)
    with pytest.raises(AssertionError):
        patchail.patch_similarity(logits, jnp.full(3, 1 / 3))


def make_rewarder(variant):
    return patchail.make_rewarder(
        make_agent(),
        variant=variant,
        width=2,
        learning_rate=1e-4,
        gradient_penalty=10.0,
        batch_size=4,
        relabels=False,
    )


def test_variants_weigh_the_mean_logit_or_add_to_it():
    first, later = (make_episode(random_frames(seed, 6)) for seed in (0, 1))

    @jax.jit
    def play(first, later):
        rewards = {}
        for variant in ("plain", "weighted", "bonus"):
            rewarder = make_rewarder(variant)
            state = rewarder.init(jax.random.key(0), make_spec(expert_steps=4), NOBODY)
            for episode in (first, later):  # the first one sets the scale
                state = rewarder.observe(state, NOBODY, episode, None)
            rewards[variant] = rewarder.rewards(state, NOBODY, first, None)
        return rewards

    rewards = jax.tree.map(np.asarray, play(first, later))
    weights = rewards["weighted"] / rewards["plain"]
    bonuses = rewards["bonus"] - 0.5 * rewards["plain"]
    np.testing.assert_allclose(np.mean(weights), 1.3, rtol=1e-3)
    np.testing.assert_allclose(np.mean(bonuses), 0.5, rtol=1e-3)
    np.testing.assert_allclose(weights / 1.3, bonuses / 0.5, rtol=1e-3)
    assert np.ptp(bonuses) > 1e-5


def test_state_vectors_are_refused_at_the_door():
    config = jaxil_config.default_config("patchail", "walker_walk")
    assert jaxil_config.problems(config, ("walker_walk",)) == []
    config.observation = "state"
    (fault,) = jaxil_config.problems(config, ("walker_walk",))
    assert fault.subject == "observation"
    assert "PatchAIL" in str(fault)
