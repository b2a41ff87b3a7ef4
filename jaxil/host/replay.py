"""The replay: a NumPy ring of single frames, from which n-step windows are drawn.

Each frame is stored once and stacks are made when they are sampled, so that the paper's
150000 steps of 84x84 pixels take 3.2 GB (stored stacks would take 9.5 GB). Whole
episodes enter, and the oldest whole episodes leave.

Axes: B batch, T steps of an episode, n the length of a window, H W C pixels.
"""

import collections
import math
from typing import NamedTuple

import numpy as np

from jaxil.host.stacking import gather_stacks


class Window(NamedTuple):
    """All transitions of n-step windows, for methods that reward them anew."""

    observation: np.ndarray  # [B, n, H, W, C * stack] uint8, or [B, n, S] float32
    action: np.ndarray  # [B, n, A] float32
    weight: np.ndarray  # [B, n] float32: what each reward is multiplied by in the sum


class Batch(NamedTuple):
    """Transitions over n steps, as the learner gets them.

    From `sample_indices`, with slots of frames in the place of pixels.
    """

    observation: np.ndarray  # [B, H, W, C * stack] uint8, or [B, S] float32: o_t
    action: np.ndarray  # [B, A] float32: a_t
    reward: np.ndarray  # [B] float32: discounted sum of r_t ... r_{t+n-1}
    discount: np.ndarray  # [B] float32: what the value of o_{t+n} is multiplied by
    next_observation: np.ndarray  # like observation: o_{t+n}
    window: Window | None  # None unless asked for


class Episode(NamedTuple):
    """One episode as it is stored."""

    frames: np.ndarray  # [T + 1, H, W, C] uint8 or [T + 1, S] float32
    actions: np.ndarray  # [T, A] float32
    rewards: np.ndarray  # [T] float32: rewards[t] belongs to (o_t, a_t, o_{t+1})
    discounts: np.ndarray  # [T] float32: the environment's own, 0 after a true end


class _Stored(NamedTuple):
    start: int  # slot of the episode's first frame
    num_steps: int


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
    return frames + _num_slots(capacity_steps, episode_steps) * 4 * (action_dim + 2)


def frames_bytes(
    *,
    capacity_steps: int,
    episode_steps: int,
    observation_shape: tuple[int, ...],
    observation_dtype,
) -> int:
    """Says how much of `memory_bytes` is frames, of which a device may hold a copy."""
    frame_bytes = math.prod(observation_shape) * np.dtype(observation_dtype).itemsize
    return _num_slots(capacity_steps, episode_steps) * frame_bytes


def _num_slots(capacity_steps: int, episode_steps: int) -> int:
    return capacity_steps + math.ceil(capacity_steps / episode_steps)


class Replay:
    """Stores the newest episodes and samples n-step transitions from them, uniformly.

    The next free slot follows the newest frame, modulo the ring's length; an episode
    may run over the ring's end. A slot holds o_t with the a_t, r_t and d_t that follow.
    """

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
        shape = tuple(observation_shape)
        for name, value, rule, holds in (
            ("episode_steps", episode_steps, ">= 1", episode_steps >= 1),
            ("observation_shape", shape, "(H, W, C) or (S,)", len(shape) in (1, 3)),
            ("action_dim", action_dim, ">= 1", action_dim >= 1),
            ("frame_stack", frame_stack, ">= 1", frame_stack >= 1),
            ("num_steps", num_steps, ">= 1", num_steps >= 1),
            (
                "discount_factor",
                discount_factor,
                "in [0, 1]",
                0 <= discount_factor <= 1,
            ),
        ):
            _require(holds, name, value, rule)
        enough = f"room for an episode, {episode_steps} steps"
        _require(
            capacity_steps >= episode_steps, "capacity_steps", capacity_steps, enough
        )
        states = len(shape) == 1
        _require(
            not states or frame_stack == 1, "frame_stack", frame_stack, "1 for states"
        )
        self._capacity_steps = capacity_steps
        self._frame_stack = frame_stack
        self._window = num_steps
        self._discount_factor = discount_factor
        num_slots = _num_slots(capacity_steps, episode_steps)
        # np.empty and np.zeros touch no page yet: memory use grows with the run.
        self._frames = np.empty((num_slots, *shape), observation_dtype)
        self._actions = np.zeros((num_slots, action_dim), np.float32)
        self._rewards = np.zeros(num_slots, np.float32)
        self._discounts = np.zeros(num_slots, np.float32)
        self.clear()

    def clear(self, first_episode: int = 0) -> None:
        """Forgets all episodes; the next one added gets the number `first_episode`."""
        self._stored: collections.deque[_Stored] = collections.deque()
        self._num_episodes_added = first_episode
        self._num_steps_stored = 0
        self._num_frames_stored = 0
        self._next_slot = 0
        self._index_starts()

    @property
    def frames(self) -> np.ndarray:
        """The ring of frames itself, read-only: [num_slots, H, W, C] or [.., S]."""
        ring = self._frames.view()
        ring.flags.writeable = False
        return ring

    @property
    def num_steps_stored(self) -> int:
        """Transitions in the replay now."""
        return self._num_steps_stored

    @property
    def num_episodes_stored(self) -> int:
        """Episodes in the replay now."""
        return len(self._stored)

    @property
    def num_episodes_added(self) -> int:
        """Episodes ever added; the newest one has the number below this."""
        return self._num_episodes_added

    @property
    def oldest_episode(self) -> int:
        """Number of the oldest episode that is still stored."""
        return self._num_episodes_added - len(self._stored)

    def add_episode(self, *, frames, actions, rewards, discounts) -> None:
        """Copies one whole episode in; the oldest ones make room for it.

        Args:
          frames: [T + 1, H, W, C] uint8, or [T + 1, S] float32: o_0 ... o_T, unstacked.
          actions: [T, A] float, finite: actions[t] was taken on seeing o_t.
          rewards: [T] float, finite: rewards[t] came with o_{t+1}.
          discounts: [T] float in [0, 1]: 0 after a true end, 1 at a time limit.

        Raises:
          ValueError: for a wrong shape or dtype, a number that is not finite, or an
            episode that is longer than the replay; nothing is changed then.
        """
        frames, actions, rewards, discounts = self._checked(
            frames, actions, rewards, discounts
        )
        num_steps = len(rewards)
        num_slots = len(self._frames)
        fits = num_steps <= self._capacity_steps and num_steps < num_slots
        _require(
            fits, "episode length", num_steps, f"at most {self._capacity_steps} steps"
        )

        while (
            self._num_steps_stored + num_steps > self._capacity_steps
            or self._num_frames_stored + num_steps + 1 > num_slots
        ):
            evicted = self._stored.popleft()
            self._num_steps_stored -= evicted.num_steps
            self._num_frames_stored -= evicted.num_steps + 1
        start = self._next_slot
        # In two pieces where the ring ends: slices copy faster than index lists.
        head = min(num_steps + 1, num_slots - start)
        self._frames[start : start + head] = frames[:head]
        self._frames[: num_steps + 1 - head] = frames[head:]
        slots = (start + np.arange(num_steps)) % num_slots
        self._actions[slots] = actions
        self._rewards[slots] = rewards
        self._discounts[slots] = discounts
        self._stored.append(_Stored(start, num_steps))
        self._next_slot = (start + num_steps + 1) % num_slots
        self._num_steps_stored += num_steps
        self._num_frames_stored += num_steps + 1
        self._num_episodes_added += 1
        self._index_starts()

    def episode(self, index: int) -> Episode:
        """Copies one stored episode out.

        Args:
          index: its number, `oldest_episode` <= index < `num_episodes_added`.

        Raises:
          IndexError: if it is not stored.
        """
        slots = self.slots(index)
        return Episode(
            frames=self._frames[slots],
            actions=self._actions[slots[:-1]],
            rewards=self._rewards[slots[:-1]],
            discounts=self._discounts[slots[:-1]],
        )

    def slots(self, index: int) -> np.ndarray:
        """Returns where the frames of a stored episode lie in `frames`, [T + 1].

        Args:
          index: see `episode`.

        Raises:
          IndexError: if it is not stored.
        """
        if not self.oldest_episode <= index < self._num_episodes_added:
            raise IndexError(
                f"episode {index} is not stored: the replay holds"
                f" {self.oldest_episode} to {self._num_episodes_added - 1}"
            )
        start, num_steps = self._stored[index - self.oldest_episode]
        return (start + np.arange(num_steps + 1)) % len(self._frames)

    def can_sample(self) -> bool:
        """Says whether any stored episode is long enough for a window of n steps."""
        return self._num_starts > 0

    def sample(
        self, rng: np.random.Generator, batch_size: int, *, windows: bool = False
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

        Returns:
          A batch of fresh arrays in C order.

        Raises:
          ValueError: if no stored episode is as long as a window.
        """
        drawn = self.sample_indices(rng, batch_size, windows=windows)
        # Both ends of the windows in one go: the work is shared out among threads.
        # Where all of a window is asked for, its inside comes first of all.
        first = drawn.observation[None]
        if drawn.window is not None:
            first = drawn.window.observation.swapaxes(0, 1)
        slots = np.concatenate([first, drawn.next_observation[None]])
        stacks = gather_stacks(self._frames, slots.reshape(-1, self._frame_stack))
        stacks = stacks.reshape(*slots.shape[:2], *stacks.shape[1:])
        if drawn.window is not None:
            inside = np.ascontiguousarray(stacks[:-1].swapaxes(0, 1))
            drawn = drawn._replace(window=drawn.window._replace(observation=inside))
        return drawn._replace(observation=stacks[0], next_observation=stacks[-1])

    def sample_indices(
        self, rng: np.random.Generator, batch_size: int, *, windows: bool = False
    ) -> Batch:
        """Draws what `sample` draws, with the places of frames instead of pixels.

        Args:
          rng: see `sample`; the same one gives the same transitions.
          batch_size: B >= 1.
          windows: see `sample`.

        Returns:
          A batch in which each stack [H, W, C * stack] is the int32 [stack] of its
          frames' slots in `frames`, the oldest first. They hold until the next
          episode is added.

        Raises:
          ValueError: if no stored episode is as long as a window.
        """
        if not self.can_sample():
            raise ValueError(
                f"num_steps_stored = {self._num_steps_stored}: expected an episode of"
                f" at least {self._window} steps; add one before sampling"
            )
        flat = rng.integers(self._num_starts, size=batch_size)
        which = np.searchsorted(self._last_starts, flat, side="right")
        steps = flat - self._first_starts[which]  # t of each window in its episode
        starts = self._episode_slots[which]

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
            window=window,
        )

    def check_valid(self) -> tuple[bool, str]:
        """Checks that the books agree with one another.

        Returns:
          (True, "") or (False, what is wrong).
        """
        num_slots = len(self._frames)
        steps = sum(stored.num_steps for stored in self._stored)
        frames = steps + len(self._stored)
        if steps != self._num_steps_stored or steps > self._capacity_steps:
            return False, (
                f"{steps} steps stored, counted {self._num_steps_stored},"
                f" capacity {self._capacity_steps}"
            )
        if frames != self._num_frames_stored or frames > num_slots:
            return False, (
                f"{frames} frames stored, counted {self._num_frames_stored},"
                f" {num_slots} slots"
            )
        if self.oldest_episode < 0:
            return False, f"oldest episode is number {self.oldest_episode}"
        expected = (self._next_slot - frames) % num_slots
        for number, stored in enumerate(self._stored, start=self.oldest_episode):
            if stored.num_steps < 1:
                return False, f"episode {number} has {stored.num_steps} steps"
            if stored.start != expected:
                return False, (
                    f"episode {number} starts in slot {stored.start}:"
                    f" expected {expected}"
                )
            expected = (expected + stored.num_steps + 1) % num_slots
        windows = sum(max(s.num_steps - self._window + 1, 0) for s in self._stored)
        if windows != self._num_starts:
            return False, f"{windows} windows stored, {self._num_starts} indexed"
        return True, ""

    def _checked(self, frames, actions, rewards, discounts) -> Episode:
        """Returns the arrays in the types that are stored, or raises ValueError."""
        frames = np.asarray(frames)
        _require(frames.ndim > 0, "frames.shape", frames.shape, "[T + 1, ...]")
        _require(len(frames) > 1, "frames.shape", frames.shape, "at least two frames")
        arrays = []
        for name, array, ring in (
            ("frames", frames, self._frames),
            ("actions", np.asarray(actions), self._actions),
            ("rewards", np.asarray(rewards), self._rewards),
            ("discounts", np.asarray(discounts), self._discounts),
        ):
            expected = (len(frames) - (name != "frames"), *ring.shape[1:])
            _require(array.shape == expected, f"{name}.shape", array.shape, expected)
            if name == "frames":
                same = array.dtype == ring.dtype
                _require(same, "frames.dtype", array.dtype, ring.dtype)
            else:
                real = array.dtype.kind in "fiu"
                _require(real, f"{name}.dtype", array.dtype, "real numbers")
                with np.errstate(over="ignore"):  # becomes inf, which is refused below
                    array = array.astype(ring.dtype)
            good, rule = np.isfinite(array), "finite"
            if name == "discounts":
                good, rule = (array >= 0) & (array <= 1), "in [0, 1]"
            if not good.all():
                first = tuple(np.argwhere(~good)[0].tolist())
                _require(False, f"{name}{list(first)}", array[first], rule)
            arrays.append(array)
        return Episode(*arrays)

    def _index_starts(self) -> None:
        """Lays the starts of all windows end to end, so that one draw picks one."""
        lengths = np.array([stored.num_steps for stored in self._stored], np.int64)
        counts = np.maximum(lengths - self._window + 1, 0)
        self._last_starts = np.cumsum(counts)  # exclusive end of each episode's starts
        self._first_starts = self._last_starts - counts
        self._episode_slots = np.array([stored.start for stored in self._stored], int)
        self._num_starts = int(counts.sum())

    def _stack_slots(self, starts: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Says where the frames of o_t lie, of episodes that begin in slots `starts`.

        Returns:
          int32, a last axis of frames added, the oldest first.
        """
        ages = np.arange(self._frame_stack)[::-1]
        slots = starts[..., None] + np.maximum(steps[..., None] - ages, 0)
        return (slots % len(self._frames)).astype(np.int32)


def _require(condition: bool, name: str, value: object, rule: object) -> None:
    if not condition:
        raise ValueError(f"{name} = {value}: expected {rule}")
