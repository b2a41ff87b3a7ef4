"""Methods with cloning small enough for tests, their learners and samples."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.learner.rewarder import AgentSpec, AgentView, Spec
from jaxil.learner.update import init_train_state
from jaxil.maths.types import Batch, ExpertBatch
from jaxil.rewarders import pdac, pdac_cloning, psil, psil_cloning
from jaxil.rewarders.inferred_actions import with_cloning
from tests.rewarders.small_world import SIDE, STATE_DIM, learner_with
from tests.tiny_agent import make_tiny_networks, random_actions

BATCH = 16
OF_PDAC: dict[str, Any] = {
    "hidden_dim": 16,
    "learning_rate": 3e-3,
    "gradient_penalty": 10.0,
    "batch_size": 8,
    "sees_actions": False,
    "num_components": 0,
}
OF_PSIL: dict[str, Any] = {
    "cost": "cosine",
    "alignment": "transport",
    "epsilon": 0.01,
    "num_iterations": 20,
    "target_update_steps": 10,
    "return_scale": 10.0,
    "num_components": 0,
}
OF_CLONING: dict[str, Any] = {
    "num_pairs": 6,
    "weight": 0.4,
    "trust": "agreement",
    "trust_scale": 0.05,
    "num_models": 3,
    "head_dim": 16,
    "model_learning_rate": 3e-3,
}
KINDS = ["state", "pixels"]


def compiled(function):
    """Most programs run once or twice: fast code is not worth its compilation."""
    options = {"xla_backend_optimization_level": 0}
    return jax.jit(function, compiler_options=options)


def make_agent(kind="state", shift_padding=0):
    networks = make_tiny_networks(feature_dim=16, hidden_dim=32, observation=kind)
    return AgentSpec(networks, 1, shift_padding)


def make_learner(rewarder, kind="state", shift_padding=0):
    return learner_with(make_agent(kind).networks, rewarder, shift_padding)


def shape_of(kind):
    return (STATE_DIM,) if kind == "state" else (SIDE, SIDE, 3)


def make_state(learner, kind="state"):
    spec = Spec(2, 2, expert_steps=4, observation_shape=shape_of(kind))
    example = np.zeros(shape_of(kind), np.float32 if kind == "state" else np.uint8)
    init = compiled(lambda key: init_train_state(learner, key, example, spec))
    return init(jax.random.key(0))


def observations(seed, kind, *shape) -> Any:
    rng = np.random.default_rng(seed)
    if kind == "state":
        return rng.uniform(-1, 1, (*shape, STATE_DIM)).astype(np.float32)
    return rng.integers(0, 256, (*shape, SIDE, SIDE, 3), dtype=np.uint8)


def make_batch(kind="state", seed=0):
    now, next_, successor = (observations(seed + n, kind, BATCH) for n in range(3))
    reward = np.random.default_rng(seed).normal(size=BATCH).astype(np.float32)
    discount = np.full(BATCH, 0.9, np.float32)
    return Batch(now, random_actions(seed, BATCH), reward, discount, next_, successor)


def make_expert(size, kind="state", seed=10):
    """Expert samples whose actions nobody may read."""
    now, successor = (observations(seed + n, kind, size) for n in range(2))
    return ExpertBatch(now, np.full((size, 2), np.nan, np.float32), successor)


def make_methods(name, kind="state", shift_padding=0, **changes):
    """Returns a method, and the same with cloning."""
    agent, own = make_agent(kind, shift_padding), OF_CLONING | changes
    if name == "pdac":
        return (
            pdac.make_rewarder(agent, **OF_PDAC),
            pdac_cloning.make_rewarder(agent, **OF_PDAC, **own),
        )
    return (
        psil.make_rewarder(agent, **OF_PSIL),
        psil_cloning.make_rewarder(agent, **OF_PSIL, **own),
    )


def assert_same(ours, theirs, atol=0.0):
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=0.0, atol=atol),
        ours,
        theirs,
    )


def differ(ours, theirs):
    return any(
        jax.tree.leaves(jax.tree.map(lambda x, y: bool(np.any(x != y)), ours, theirs))
    )


def given(inner, num_pairs=6):
    """Returns the method, and its state, samples and parameters."""
    own: dict[str, Any] = OF_CLONING | {"num_pairs": num_pairs}
    ours = with_cloning(inner, make_agent(), **own)
    state = make_state(make_learner(ours))
    batch = make_batch()
    view = AgentView(
        batch.observation,
        jnp.zeros((BATCH, 16)),
        batch.action,
        batch.observation,
        batch.successor,
        jnp.zeros((BATCH, 16)),
        batch.successor,
    )
    return ours, state, view, make_expert(ours.expert_batch_size)
