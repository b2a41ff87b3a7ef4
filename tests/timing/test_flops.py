"""Operations of an update, against hand-worked numbers and against XLA's own count."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil.learner.rewarder import Spec
from jaxil.learner.update import Learner, init_train_state, make_update_step
from jaxil.maths.types import Batch, ExpertBatch
from jaxil.timing import arithmetic, flops
from jaxil.timing.parts import make_parts
from jaxil.training import assembly

# Two inputs, one feature, two hidden units, one action: small enough to count.
_TINY = flops.Sizes(
    encoder=(12, 20), representation_dim=5, feature_dim=1, hidden_dim=2, action_dim=1
)


def test_convolutions_of_the_paper_by_hand():
    layers, representation_dim = flops.pixel_encoder(
        84, 9, channels=(32,) * 4, kernel_sizes=(3,) * 4, strides=(2, 1, 1, 1)
    )
    # Sides 41, 39, 37, 35; 9 input channels, then 32.
    assert layers == (
        41 * 41 * 32 * 81,
        39 * 39 * 32 * 288,
        37 * 37 * 32 * 288,
        35 * 35 * 32 * 288,
    )
    assert representation_dim == 39_200


def test_parts_of_a_tiny_learner_by_hand():
    # Trunk 5, actor's MLP 1*2 + 2*2 + 2*1 = 8, each critic's 2*2 + 2*2 + 2*1 = 10.
    parts = flops.drqv2_update(_TINY, batch_size=3)
    # Forward 32 twice, gradients of weights 32 and of the second layer's input 20.
    assert parts["encoder"] == 2 * 3 * (32 + 32 + 32 + 20)
    # Target: 5 + 8 + 5 + 20. Loss: three passes of 5 + 20.
    assert parts["critic"] == 2 * 3 * (38 + 75)
    # Actor: 5 and its weights, three passes of 8. Critic: 5, twice 20.
    assert parts["actor"] == 2 * 3 * (10 + 24 + 5 + 40)


def test_a_tiny_discriminator_by_hand():
    discriminator = flops.Discriminator(batch_size=4, hidden_dim=2, sees_actions=True)
    # MLP 2*2 + 2*2 + 2*1 = 10. Features 32 + 5; loss on two batches, 3 * 10 less the
    # first layer's input, 4, each; penalty four passes of 10.
    assert flops.adversarial_update(_TINY, discriminator) == 2 * 4 * (37 + 52 + 40)


def test_cloning_by_hand():
    parts = flops.cloning_update(_TINY, batch_size=3)
    assert parts == {"encoder": 2 * 3 * (32 + 32 + 20), "actor": 2 * 3 * 3 * 13}


def test_a_matrix_product_by_hand():
    assert flops.matrix_product(2) == 16  # 8 products, 8 sums, the first of them to 0


def test_the_paper_s_update_takes_a_hundred_gflop():
    config = jaxil_config.default_config("drqv2", "cartpole_swingup")
    parts = arithmetic.by_part(config, (84, 84, 3), 1)
    assert parts is not None
    total = sum(parts.values())
    assert total == pytest.approx(101.4e9, rel=0.001)
    assert parts["encoder"] / total == pytest.approx(0.83, abs=0.01)


def test_methods_without_a_simple_count_have_none():
    for method in ("dac", "sil"):
        config = jaxil_config.default_config(method, "cartpole_swingup")
        assert arithmetic.by_part(config, (84, 84, 3), 1) is None


@pytest.fixture(scope="module")
def taken_apart():
    """P-DAC with products that outweigh activations, as the paper's do."""
    config = jaxil_config.default_config("pdac", "cartpole_swingup")
    config.image_size = 40
    config.hidden_dim = config.discriminator.hidden_dim = 256
    config.batch_size, config.discriminator.batch_size = 64, 32
    config.encoder.convolutions = "xla"  # which XLA can count
    return config, *_parts_of(config)


def _parts_of(config):
    rng = np.random.default_rng(0)

    def pixels(size):
        shape = (size, config.image_size, config.image_size, 9)
        return jnp.asarray(rng.integers(0, 256, shape), jnp.uint8)

    size, experts = config.batch_size, config.discriminator.batch_size
    action, ones = jnp.zeros((size, 1)), jnp.ones(size)
    batch = Batch(pixels(size), action, ones, ones, pixels(size))
    expert = ExpertBatch(pixels(experts), jnp.zeros((experts, 1)))
    networks = assembly.make_networks(config, 1, 0.5)
    rewarder = assembly.make_rewarder(config, networks)
    settings = {
        "learning_rate": 1e-4,
        "critic_target_tau": 0.01,
        "noise_clip": 0.3,
        "shift_padding": 4,
    }
    learner = Learner(
        networks=networks,
        rewarder=rewarder,
        pre_tanh_penalty=0.0,
        exploration_std=lambda n: 0.1,
        **settings,
    )
    shape = batch.observation.shape[1:]
    spec = Spec(1, config.feature_dim, 0, 0, shape)
    key = jax.random.key(0)
    state = init_train_state(learner, key, np.zeros(shape, np.uint8), spec)
    parts = make_parts(networks, rewarder, state, batch, expert, **settings)
    return parts, make_update_step(learner), (state, batch, expert)


def _count(function, *arguments) -> float:
    analysis = jax.jit(function).lower(*arguments).cost_analysis()
    assert analysis is not None
    return analysis["flops"]


def test_hand_and_xla_count_the_same_in_each_part(taken_apart):
    config, parts, update_step, arguments = taken_apart
    by_hand = arithmetic.by_part(config, (40, 40, 3), 1)
    assert by_hand is not None
    assert set(parts) == {*by_hand, "optimiser"}
    for name, count in by_hand.items():
        # XLA has activations on top, and does not count less.
        assert count < _count(parts[name]) < 1.12 * count, name
    whole = _count(update_step, *arguments)
    assert sum(by_hand.values()) < whole < 1.12 * sum(by_hand.values())


def test_a_part_gives_gradients_of_its_weights(taken_apart):
    _, parts, _, (state, _, _) = taken_apart
    gradients = {
        "encoder": parts["encoder"]()[0][0],
        "critic": parts["critic"]()[0],
        "actor": parts["actor"](),
    }
    for name, tree in gradients.items():
        params = getattr(state.params, name)
        assert jax.tree.structure(tree) == jax.tree.structure(params)
        assert all(jnp.any(leaf != 0) for leaf in jax.tree.leaves(tree)), name


def test_the_optimiser_s_part_moves_its_own_copy(taken_apart):
    _, parts, _, (state, _, _) = taken_apart
    before = jax.tree.map(np.asarray, state.encoder.params)
    for _ in range(2):  # it gives its own state away each time
        (encoder, _, _), _ = parts["optimiser"]()
    chex.assert_trees_all_equal(before, state.encoder.params)
    kernel = before["params"]["Conv_0"]["kernel"]
    assert np.all(encoder.params["params"]["Conv_0"]["kernel"] != kernel)
