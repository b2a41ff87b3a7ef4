"""Learning steps that assemble stacks from frames kept on the device."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxil.learner.state import TrainState
from jaxil.maths.stacking import gather_stacks
from jaxil.maths.types import Batch, Data, ExpertBatch, Metrics

Step = Callable[..., tuple[TrainState, Metrics]]


class Frames(NamedTuple):
    """All frames that batches are sampled from, on the device.

    Attributes:
      agent: the replay's, uint8 [N, H, W, 3] or float32 [N, S]; None for a method
        that plays no episodes.
      expert: the demonstrations', uint8 [K, M, H, W, 3] or float32 [K, M, S]; None
        for a method that samples none.
    """

    agent: Data | None
    expert: Data | None


def gather_batch(frames: Data, batch: Batch) -> Batch:
    """Replaces the frame indices of a batch from `Replay.sample` with stacks."""
    return batch.map_observations(functools.partial(gather_stacks, frames))


def gather_expert(frames: Data, expert: ExpertBatch) -> ExpertBatch:
    """Replaces indices [B, F] of the concatenated episodes' frames with stacks."""
    chex.assert_rank(frames, {3, 5})
    flat = jnp.asarray(frames).reshape(-1, *frames.shape[2:])
    return expert.map_observations(functools.partial(gather_stacks, flat))


def make_gathering_step(step: Step) -> Step:
    """Returns a step that also accepts frame indices, together with the frames.

    (state, batch, expert, frames) -> (state, metrics). With frames, batches hold
    indices instead of pixels, see `gather_batch` and `gather_expert`.
    """

    def gathering_step(
        state: TrainState,
        batch: Batch | None,
        expert: ExpertBatch | None,
        frames: Frames | None = None,
    ) -> tuple[TrainState, Metrics]:
        if frames is not None:
            if batch is not None:
                batch = gather_batch(frames.agent, batch)
            if expert is not None:
                expert = gather_expert(frames.expert, expert)
            # Otherwise XLA may fuse the gathering with what follows and sum in another
            # order: a run would depend on where its frames are.
            batch, expert = jax.lax.optimization_barrier((batch, expert))
        return step(state, batch, expert)

    return gathering_step


def make_repeated_step(step: Step) -> Step:
    """Returns a step of `make_gathering_step` that makes n updates in one call.

    Its batches have a leading axis of length n; its metrics are the last update's.
    """

    def repeated_step(
        state: TrainState,
        batch: Batch | None,
        expert: ExpertBatch | None,
        frames: Frames | None = None,
    ) -> tuple[TrainState, Metrics]:
        def update(state: TrainState, batches: tuple) -> tuple[TrainState, Metrics]:
            return step(state, *batches, frames)

        state, metrics = jax.lax.scan(update, state, (batch, expert))
        return state, jax.tree.map(lambda values: values[-1], metrics)

    return repeated_step
