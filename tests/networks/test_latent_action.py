"""The latent-action model: its sizes, and what reaches what."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.networks.latent_action import LatentActionModel

MODEL = LatentActionModel(
    num_parts=3, num_codes=5, part_dim=2, hidden_dim=8, feature_dim=4, action_dim=2
)


def _inputs(count=6):
    return jax.random.normal(jax.random.key(1), (2, count, 4))


def test_parameters_by_hand():
    features = jax.ShapeDtypeStruct((1, 4), jnp.float32)
    params = jax.eval_shape(MODEL.init, jax.random.key(0), features, features)
    sizes = {
        name: sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(part))
        for name, part in params["params"].items()
    }
    assert sizes == {
        "inverse": (8 * 8 + 8) + (8 * 8 + 8) + (8 * 6 + 6),
        "forward": ((4 + 6) * 8 + 8) + (8 * 8 + 8) + (8 * 4 + 4),
        "decoder": (6 * 192 + 192) + (192 * 128 + 128) + (128 * 64 + 64) + (64 * 2 + 2),
        "codebook": 3 * 5 * 2,
    }


def test_first_codes_are_small_and_differ():
    params = jax.jit(MODEL.init)(jax.random.key(0), *_inputs())
    codebook = np.asarray(params["params"]["codebook"])
    assert np.abs(codebook).max() <= 1.0  # five over their number, which is five
    assert len(np.unique(codebook)) == codebook.size


def test_shapes_and_ranges():
    features, successor = _inputs()
    params = jax.jit(MODEL.init)(jax.random.key(0), features, successor)

    @jax.jit
    def run(params):
        latent: Any = MODEL.apply(params, features, successor, method=MODEL.infer)
        indices = MODEL.apply(params, latent, method=MODEL.nearest)
        codes = MODEL.apply(params, indices, method=MODEL.codes)
        predicted = MODEL.apply(params, features, codes, method=MODEL.predict)
        action = MODEL.apply(params, 100.0 * latent, method=MODEL.decode)
        return latent, indices, codes, predicted, action

    latent, indices, codes, predicted, action = run(params)
    assert latent.shape == codes.shape == (6, 3, 2)
    assert indices.shape == (6, 3)
    assert predicted.shape == (6, 4)
    assert action.shape == (6, 2)
    assert np.abs(action).max() <= 1.0
    assert indices.min() >= 0
    assert indices.max() < 5
    together = jax.jit(MODEL.apply)(params, features, successor)
    np.testing.assert_allclose(together[0], predicted, rtol=1e-5, atol=1e-6)
