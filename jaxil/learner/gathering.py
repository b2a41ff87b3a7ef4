"""Stacks of frames, gathered on the device from the frames that are there."""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import Array

from jaxil.learner.state import TrainState
from jaxil.maths.types import Batch, Data, ExpertBatch, Metrics

Step = Callable[..., tuple[TrainState, Metrics]]


class Frames(NamedTuple):
    """All frames that batches are sampled from, on the device.

    Attributes:
      agent: those of the replay, uint8 [N, H, W, 3] or float32 [N, S]; None for a
        method that plays no episodes.
      expert: the demonstrations', uint8 [K, M, H, W, 3] or float32 [K, M, S]; None
        for a method that samples none.
    """

    agent: Data | None
    expert: Data | None


def gather_stacks(frames: Data, indices: Data) -> Array:
    """Gathers frames and folds each stack of them into the channels.

    Args:
      frames: shape [N, H, W, C], or [N, S] if F is 1.
      indices: int32 [..., F] in [0, N): the frames of each stack, the oldest first.

    Returns:
      Shape [..., H, W, F * C], or [..., S].
    """
    chex.assert_rank(frames, {2, 4})
    gathered = jnp.asarray(frames).at[indices].get(mode="promise_in_bounds")
    if frames.ndim == 2:
        chex.assert_axis_dimension(indices, -1, 1)
        return jnp.squeeze(gathered, -2)
    # [..., F, H, W, C] to [..., H, W, F, C], whose last two axes are the channels.
    gathered = jnp.moveaxis(gathered, -4, -2)
    return gathered.reshape(*gathered.shape[:-2], -1)


def gather_batch(frames: Data, batch: Batch) -> Batch:
    """Replaces indices by pixels.

    Args:
      frames: see `gather_stacks`.
      batch: as the replay's `sample_indices` returns it: observations int32 [B, F],
        those of a window [B, n, F].
    """
    window = batch.window
    if window is not None:
        window = window._replace(observation=gather_stacks(frames, window.observation))
    successor = batch.successor
    if successor is not None:
        successor = gather_stacks(frames, successor)
    return batch._replace(
        observation=gather_stacks(frames, batch.observation),
        next_observation=gather_stacks(frames, batch.next_observation),
        successor=successor,
        window=window,
    )


def gather_expert(frames: Data, expert: ExpertBatch) -> ExpertBatch:
    """Replaces indices by pixels.

    Args:
      frames: of whole episodes, see `Frames.expert`.
      expert: observations int32 [B, F], indices into the episodes laid end to end.
    """
    chex.assert_rank(frames, {3, 5})
    row = jnp.asarray(frames).reshape(-1, *frames.shape[2:])
    successor = expert.successor
    if successor is not None:
        successor = gather_stacks(row, successor)
    return expert._replace(
        observation=gather_stacks(row, expert.observation), successor=successor
    )


def make_gathering_step(step: Step) -> Step:
    """Returns a learning step for batches with or without their pixels.

    (state, batch, expert, frames) -> (state, metrics). With frames, batches hold their
    indices, see `gather_batch` and `gather_expert`; without, they are those that `step`
    takes.

    Args:
      step: the learning step, (state, batch, expert) -> (state, metrics).
    """

    def gathering_step(
        state: TrainState,
        batch: Batch | None,
        expert: ExpertBatch | None,
        frames: Frames | None = None,
    ) -> tuple[TrainState, Metrics]:
        if frames is not None and batch is not None:
            batch = gather_batch(frames.agent, batch)
        if frames is not None and expert is not None:
            expert = gather_expert(frames.expert, expert)
        if frames is not None:
            # Without it, XLA may fuse what follows with the gathering and sum in
            # another order: a run's numbers would depend on where its frames are.
            batch, expert = jax.lax.optimization_barrier((batch, expert))
        return step(state, batch, expert)

    return gathering_step


def make_repeated_step(step: Step) -> Step:
    """Returns a step that makes n updates in one call.

    Its batches have a first axis of length n; its metrics are those of the last update.

    Args:
      step: as `make_gathering_step` returns it.
    """

    def repeated_step(
        state: TrainState,
        batch: Batch | None,
        expert: ExpertBatch | None,
        frames: Frames | None = None,
    ) -> tuple[TrainState, Metrics]:
        def update(state: TrainState, sampled: tuple) -> tuple[TrainState, Metrics]:
            return step(state, *sampled, frames)

        state, metrics = jax.lax.scan(update, state, (batch, expert))
        return state, jax.tree.map(lambda values: values[-1], metrics)

    return repeated_step
