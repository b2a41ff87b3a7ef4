"""Several updates in one call against as many calls, with and without frames."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxil.learner.gathering import (
    Frames,
    gather_batch,
    gather_expert,
    make_gathering_step,
    make_repeated_step,
)
from jaxil.learner.update import make_update_step
from jaxil.maths.types import Batch, ExpertBatch
from tests.learner.small_learner import (
    ACTIONS,
    BATCH,
    PDAC,
    SIDE,
    assert_identical,
    make_learner,
    make_state,
)

NUM_UPDATES, NUM_FRAMES, STACK = 4, 20, 2


def make_frames() -> Frames:
    rng = np.random.default_rng(0)
    shape = (SIDE, SIDE, 3)
    return Frames(
        rng.integers(0, 256, (NUM_FRAMES, *shape), dtype=np.uint8),
        rng.integers(0, 256, (2, NUM_FRAMES // 2, *shape), dtype=np.uint8),
    )


def sample(seed: int) -> tuple[Batch, ExpertBatch]:
    rng = np.random.default_rng(seed)

    def indices(size: int) -> np.ndarray:
        return rng.integers(NUM_FRAMES, size=(size, STACK)).astype(np.int32)

    def numbers(*shape: int) -> np.ndarray:
        return rng.uniform(-1, 1, shape).astype(np.float32)

    batch = Batch(
        observation=indices(BATCH),
        action=numbers(BATCH, ACTIONS),
        reward=numbers(BATCH),
        discount=numbers(BATCH),
        next_observation=indices(BATCH),
    )
    return batch, ExpertBatch(indices(4), numbers(4, ACTIONS))


def on_host(frames: Frames, batch: Batch, expert: ExpertBatch):
    """Stacks by NumPy's own concatenation."""

    def stacked(row, indices):
        return np.concatenate([row[index] for index in indices.T], axis=-1)

    experts = np.asarray(frames.expert).reshape(-1, SIDE, SIDE, 3)
    stacks = {
        name: stacked(frames.agent, getattr(batch, name))
        for name in ("observation", "next_observation", "successor")
        if getattr(batch, name) is not None
    }
    successor = expert.successor
    return batch._replace(**stacks), expert._replace(
        observation=stacked(experts, expert.observation),
        successor=None if successor is None else stacked(experts, successor),
    )


def as_many(*sampled):
    """Stacks batches along a new first axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *sampled)


LEARNER = make_learner(PDAC)
STEP = make_gathering_step(make_update_step(LEARNER))
SINGLE = jax.jit(STEP)  # compiled once for all tests, for each form of batches


def test_frames_on_the_device_change_no_update():
    frames, sampled, state = make_frames(), sample(0), make_state(LEARNER)
    gathered, _ = SINGLE(state, *sampled, frames)
    sent, _ = SINGLE(state, *on_host(frames, *sampled))
    assert_identical(gathered, sent)


def test_four_updates_in_one_call_are_four_calls_and_copy_no_frames():
    frames, start = make_frames(), make_state(LEARNER)
    samples = [sample(seed) for seed in range(NUM_UPDATES)]
    state = start
    for sampled in samples:
        state, metrics = SINGLE(state, *sampled, frames)
    # The same frames at the start of a large replay, of 22 MB.
    shape = (50_000, SIDE, SIDE, 3)
    arguments = (
        *as_many(*samples),
        frames._replace(agent=np.resize(np.asarray(frames.agent), shape)),
    )
    step = jax.jit(make_repeated_step(STEP), donate_argnums=0)
    repeated = step.lower(start, *arguments).compile()
    memory = repeated.memory_analysis()
    assert memory is not None
    assert memory.temp_size_in_bytes < 10e6
    # Twice from the same start: no call leaves a trace.
    for _ in range(2):
        given = jax.tree.map(jnp.copy, start)
        at_once, at_once_metrics = repeated(given, *arguments)
        assert at_once.num_updates == NUM_UPDATES
        # Equal up to the order of sums, which XLA chooses again inside a loop.
        for name in ("params", "target_critic"):
            ours, theirs = getattr(at_once, name), getattr(state, name)
            chex.assert_trees_all_close(ours, theirs, atol=1e-5)
        ours, theirs = at_once.rewarder.params, state.rewarder.params
        chex.assert_trees_all_close(ours, theirs, atol=1e-5)
        chex.assert_trees_all_close(at_once_metrics, metrics, rtol=1e-3, atol=1e-5)
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(given.params))


def test_successors_are_gathered_too():
    frames, (batch, expert) = make_frames(), sample(0)
    batch = batch._replace(successor=sample(1)[0].observation)
    expert = expert._replace(successor=sample(1)[1].observation)
    gathered = gather_batch(frames.agent, batch), gather_expert(frames.expert, expert)
    assert_identical(gathered, on_host(frames, batch, expert))
