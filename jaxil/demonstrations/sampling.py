"""Samples what the expert saw, on the host."""

import numpy as np

from jaxil.demonstrations.types import Demonstrations
from jaxil.maths.stacking import stack_times
from jaxil.maths.types import ExpertBatch
from jaxil.replay.stacking import gather_stacks


def sample(
    demonstrations: Demonstrations,
    rng: np.random.Generator,
    batch_size: int,
    *,
    frame_stack: int,
    successors: bool = False,
    as_indices: bool = False,
) -> ExpertBatch:
    """Samples observations and their actions uniformly from all steps.

    Args:
      frame_stack: frames in an observation; the first is repeated at the start.
      successors: whether to add the next observations.
      as_indices: whether to return observations as indices, int32 [B, frame_stack],
        oldest first, into the frames of all episodes end to end, [K * (N + 1), ...].

    Returns:
      Observations uint8 [B, H, W, 3 * frame_stack] or float32 [B, S], and actions
      [B, A]; A is 0 if they are unknown.
    """
    num_steps = demonstrations.num_frames - 1  # no action follows the last frame
    ends = np.cumsum(num_steps)
    chosen = rng.integers(ends[-1], size=batch_size)
    episodes = np.searchsorted(ends, chosen, side="right")
    steps = chosen - (ends - num_steps)[episodes]

    def stacks(times: np.ndarray) -> np.ndarray:
        inside = stack_times(times, frame_stack=frame_stack)
        first = episodes[:, None] * demonstrations.frames.shape[1]
        return (first + inside).astype(np.int32)

    actions = (
        np.zeros((batch_size, 0), np.float32)
        if demonstrations.actions is None
        else demonstrations.actions[episodes, steps]
    )
    successor = stacks(steps + 1) if successors else None
    batch = ExpertBatch(stacks(steps), actions, successor)
    if as_indices:
        return batch
    # All episodes end to end, without a copy.
    frames = demonstrations.frames.reshape(-1, *demonstrations.frames.shape[2:])
    return batch.map_observations(lambda each: gather_stacks(frames, each))
