"""The replay: a NumPy ring of single frames, from which n-step windows are drawn.

Each frame is stored once and stacks are made when they are sampled, so that the paper's
150000 steps of 84x84 pixels take 3.2 GB (stored stacks would take 9.5 GB). Whole
episodes enter, and the oldest whole episodes leave.

Axes: B batch, T steps of an episode, n the length of a window, H W C pixels.
"""

import math

import numpy as np

from jaxil.maths.types import Batch, Window
from jaxil.replay.episode import require
from jaxil.replay.ring import EpisodeRing, ring_slots
from jaxil.replay.stacking import gather_stacks


def memory_bytes(
    *,
    capacity_steps: int,
    episode_steps: int,
    observation_shape: tuple[int, ...],
    observation_dtype,
    action_dim: int,
) -> int:
    """Says how much memory a full replay of these sizes takes, in bytes.

    Args:
      capacity_steps: transitions kept at most.
      episode_steps: transitions of a usual episode; it has one frame more than that.
      observation_shape: shape of a single frame, (H, W, C), or of a state, (S,).
      observation_dtype: dtype of a frame.
      action_dim: A.
    """
    frames = frames_bytes(
        capacity_steps=capacity_steps,
        episode_steps=episode_steps,
        observation_shape=observation_shape,
        observation_dtype=observation_dtype,
    )
    return frames + ring_slots(capacity_steps, episode_steps) * 4 * (action_dim + 2)


def frames_bytes(
    *,
    capacity_steps: int,
    episode_steps: int,
    observation_shape: tuple[int, ...],
    observation_dtype,
) -> int:
    """Says how much of `memory_bytes` is frames, of which a device may hold a copy."""
    frame_bytes = math.prod(observation_shape) * np.dtype(observation_dtype).itemsize
    return ring_slots(capacity_steps, episode_steps) * frame_bytes


class Replay(EpisodeRing):
    """Stores the newest episodes and draws n-step transitions from them, uniformly."""

    def __init__(
        self,
        *,
        capacity_steps: int,
        episode_steps: int,
        observation_shape: tuple[int, ...],
        observation_dtype,
        action_dim: int,
        frame_stack: int,
        num_steps: int,
        discount_factor: float,
    ):
        """Reserves the memory; the system hands it out as it is written to.

        Args:
          capacity_steps: transitions kept at most, >= episode_steps.
          episode_steps: transitions of a usual episode (see `memory_bytes`), >= 1.
          observation_shape: shape of a single frame, (H, W, C), or of a state, (S,).
          observation_dtype: uint8 for pixels, float32 for states.
          action_dim: A >= 1.
          frame_stack: frames in an observation, >= 1; 1 for states.
          num_steps: n >= 1, the steps that a sampled transition spans.
          discount_factor: gamma in [0, 1].

        Raises:
          ValueError: if a number breaks its rule.
        """
        require(frame_stack >= 1, "frame_stack", frame_stack, ">= 1")
        require(num_steps >= 1, "num_steps", num_steps, ">= 1")
        in_range = 0 <= discount_factor <= 1
        require(in_range, "discount_factor", discount_factor, "in [0, 1]")
        stackable = len(observation_shape) != 1 or frame_stack == 1
        require(stackable, "frame_stack", frame_stack, "1 for states")
        super().__init__(
            capacity_steps=capacity_steps,
            episode_steps=episode_steps,
            observation_shape=observation_shape,
            observation_dtype=observation_dtype,
            action_dim=action_dim,
        )
        self._frame_stack = frame_stack
        self._window = num_steps
        self._discount_factor = discount_factor

    def can_sample(self) -> bool:
        """Says whether any stored episode is long enough for a window of n steps."""
        return bool(self._num_windows().any())

    def sample(
        self,
        rng: np.random.Generator,
        batch_size: int,
        *,
        windows: bool = False,
        successors: bool = False,
    ) -> Batch:
        """Draws transitions, uniformly with replacement from all windows of n steps.

        reward = sum_{k<n} gamma^k d_t ... d_{t+k-1} r_{t+k}, and
        discount = gamma^n d_t ... d_{t+n-1}, with d the environment's discounts.
        Windows stay within their episode, and so do stacks: frame 0 is repeated at its
        start.

        Args:
          rng: source of the draw; it is advanced by one call.
          batch_size: B >= 1.
          windows: whether to add each window's own transitions.
          successors: whether to add o_{t+1}.

        Returns:
          A batch of fresh arrays in C order.

        Raises:
          ValueError: if no stored episode is as long as a window.
        """
        found = self.sample_indices(
            rng, batch_size, windows=windows, successors=successors
        )
        # All stacks in one go: the work is shared out among threads.
        parts = [found.observation[None], found.next_observation[None]]
        if found.successor is not None:
            parts.append(found.successor[None])
        if found.window is not None:
            parts.append(found.window.observation.swapaxes(0, 1))
        slots = np.concatenate(parts)
        stacks = gather_stacks(self._frames, slots.reshape(-1, self._frame_stack))
        stacks = stacks.reshape(*slots.shape[:2], *stacks.shape[1:])
        window = found.window
        if window is not None:
            inside = stacks[-self._window :].swapaxes(0, 1)
            window = window._replace(observation=np.ascontiguousarray(inside))
        return found._replace(
            observation=stacks[0],
            next_observation=stacks[1],
            successor=None if found.successor is None else stacks[2],
            window=window,
        )

    def sample_indices(
        self,
        rng: np.random.Generator,
        batch_size: int,
        *,
        windows: bool = False,
        successors: bool = False,
    ) -> Batch:
        """Draws what `sample` draws, with the places of frames instead of pixels.

        Args:
          rng: see `sample`; the same one gives the same transitions.
          batch_size: B >= 1.
          windows: see `sample`.
          successors: see `sample`.

        Returns:
          A batch in which each stack [H, W, C * stack] is the int32 [stack] of its
          frames' slots in `frames`, the oldest first. They hold until the next
          episode is added.

        Raises:
          ValueError: if no stored episode is as long as a window.
        """
        num_windows = self._num_windows()
        if not num_windows.any():
            raise ValueError(
                f"num_steps_stored = {self._num_steps_stored}: expected an episode of"
                f" at least {self._window} steps; add one before sampling"
            )
        # Laid end to end, so that one draw picks an episode and a time t in it.
        ends = np.cumsum(num_windows)
        flat = rng.integers(int(ends[-1]), size=batch_size)
        which = np.searchsorted(ends, flat, side="right")
        steps = flat - (ends - num_windows)[which]
        starts = self._starts[which]

        slots = (starts + steps)[:, None] + np.arange(self._window)
        slots %= len(self._frames)
        rewards = self._rewards[slots].astype(np.float64)
        discounts = self._discount_factor * self._discounts[slots].astype(np.float64)
        discounts = np.cumprod(discounts, axis=1)
        # A reward is discounted by what lies before it, not by its own step's discount.
        weights = np.concatenate([np.ones((batch_size, 1)), discounts[:, :-1]], axis=1)

        window = None
        if windows:
            times = steps[:, None] + np.arange(self._window)
            window = Window(
                observation=self._stack_slots(starts[:, None], times),
                action=self._actions[slots],
                weight=weights.astype(np.float32),
            )
        return Batch(
            observation=self._stack_slots(starts, steps),
            action=self._actions[slots[:, 0]],
            reward=(weights * rewards).sum(axis=1).astype(np.float32),
            discount=discounts[:, -1].astype(np.float32),
            next_observation=self._stack_slots(starts, steps + self._window),
            successor=self._stack_slots(starts, steps + 1) if successors else None,
            window=window,
        )

    def _num_windows(self) -> np.ndarray:
        """Returns how many windows each stored episode has, [episodes]."""
        return np.maximum(self._lengths - self._window + 1, 0)

    def _stack_slots(self, starts: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Says where the frames of o_t lie, of episodes that begin in slots `starts`.

        Returns:
          int32, a last axis of frames added, the oldest first.
        """
        ages = np.arange(self._frame_stack)[::-1]
        slots = starts[..., None] + np.maximum(steps[..., None] - ages, 0)
        return (slots % len(self._frames)).astype(np.int32)
