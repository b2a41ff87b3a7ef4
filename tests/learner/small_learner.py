"""Learners small enough for tests, their states and batches, and comparisons."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.update import Learner, init_train_state, make_update_step
from jaxil.maths.types import Batch, ExpertBatch
from jaxil.rewarders import drqv2, pdac, psil
from tests.tiny_agent import make_tiny_networks

SIDE, CHANNELS, ACTIONS, BATCH, PADDING = 12, 6, 2, 8, 2
TAU, NOISE_CLIP, LEARNING_RATE = 0.05, 0.3, 3e-3
SPEC = Spec(
    action_dim=ACTIONS,
    num_demonstrations=2,
    expert_steps=3,
    observation_shape=(SIDE, SIDE, CHANNELS),
)
SCHEDULE = optax.linear_schedule(1.0, 0.0, 10)
NETWORKS = make_tiny_networks(
    action_dim=ACTIONS,
    hidden_dim=8,
    channels=(4, 4),
    kernel_sizes=(3, 3),
    strides=(2, 1),
)

# Made once: a learner is compiled once for all tests that share it.
AGENT = AgentSpec(NETWORKS, frame_stack=2, shift_padding=PADDING)
DRQV2 = drqv2.make_rewarder(AGENT)
PDAC = pdac.make_rewarder(
    AGENT,
    hidden_dim=8,
    learning_rate=1e-2,
    gradient_penalty=10.0,
    batch_size=4,
    sees_actions=False,
    num_components=0,
)
PSIL = psil.make_rewarder(
    AGENT,
    cost="cosine",
    alignment="transport",
    epsilon=0.01,
    num_iterations=20,
    target_update_steps=10,
    num_components=0,
    return_scale=10.0,
)


def make_learner(rewarder: Rewarder = DRQV2, **changes) -> Learner:
    learner = Learner(
        networks=NETWORKS,
        rewarder=rewarder,
        learning_rate=LEARNING_RATE,
        critic_target_tau=TAU,
        noise_clip=NOISE_CLIP,
        shift_padding=PADDING,
        pre_tanh_penalty=0.0,
        exploration_std=SCHEDULE,
    )
    return dataclasses.replace(learner, **changes)


@functools.cache
def compiled_init(networks, rewarder_init):
    """One program for all learners that start alike, instead of hundreds of small."""
    learner = make_learner(DRQV2._replace(init=rewarder_init), networks=networks)
    observation = np.zeros((SIDE, SIDE, CHANNELS), np.uint8)
    return jax.jit(lambda key: init_train_state(learner, key, observation, SPEC))


def make_state(learner: Learner, seed: int = 0):
    """A state whose target critic is not its critic, or mixing them goes unseen."""
    init = compiled_init(learner.networks, learner.rewarder.init)
    state, other = (init(jax.random.key(n)) for n in (seed, seed + 100))
    return state.replace(target_critic=other.target_critic)


def make_batch(seed: int) -> Batch:
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (2, BATCH, SIDE, SIDE, CHANNELS), dtype=np.uint8)
    return Batch(
        observation=images[0],
        action=rng.uniform(-1, 1, (BATCH, ACTIONS)).astype(np.float32),
        reward=rng.normal(size=BATCH).astype(np.float32),
        discount=rng.choice([0.0, 0.99**3], BATCH).astype(np.float32),
        next_observation=images[1],
    )


def make_expert(seed: int, size: int = 4) -> ExpertBatch:
    batch = make_batch(seed + 1000)
    return ExpertBatch(batch.observation[:size], batch.action[:size])


@functools.cache
def jitted(learner: Learner):
    # Most of these run once or twice: fast code is not worth its compilation.
    options = {"xla_backend_optimization_level": 0}
    return jax.jit(make_update_step(learner), compiler_options=options)


def numbers(leaf) -> np.ndarray:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def assert_identical(first, second):
    jax.tree.map(np.testing.assert_array_equal, *jax.tree.map(numbers, (first, second)))


def any_difference(first, second) -> bool:
    first, second = jax.tree.map(numbers, (first, second))
    leaves = jax.tree.map(lambda a, b: bool(np.any(a != b)), first, second)
    return any(jax.tree.leaves(leaves))


def padded(images: np.ndarray) -> np.ndarray:
    sides = ((0, 0), (PADDING, PADDING), (PADDING, PADDING), (0, 0))
    return np.pad(images, sides, mode="edge")


def plain_shift(images: np.ndarray, key: jax.Array) -> np.ndarray:
    """Shifts each image at random as DrQ-v2 does."""
    corners = np.asarray(jax.random.randint(key, (BATCH, 2), 0, 2 * PADDING + 1))
    return np.stack(
        [
            image[row : row + SIDE, column : column + SIDE]
            for image, (row, column) in zip(padded(images), corners)
        ]
    )
