"""A ring of NumPy arrays that keeps the newest whole episodes."""

import math
from typing import NamedTuple

import numpy as np

from jaxil.maths.types import Episode
from jaxil.replay.episode import checked_episode, checked_values, require


class _Stored(NamedTuple):
    start: int  # slot of the episode's first frame
    num_steps: int
    total_reward: float


class EpisodeRing:
    """Stores the newest episodes, numbered in the order in which they were added.

    The next free slot follows the newest frame, modulo the ring's length, so an episode
    may wrap around. Slots hold o_t with the a_t, r_t and d_t that follow.
    """

    def __init__(
        self,
        *,
        capacity_steps: int,
        episode_steps: int,
        observation_shape: tuple[int, ...],
        observation_dtype,
        action_dim: int,
    ):
        """Allocates the memory.

        Args:
          capacity_steps: transitions to keep, >= episode_steps.
          episode_steps: transitions of a usual episode, >= 1.
          observation_shape: of a single frame, (H, W, C), or of a state, (S,).
          observation_dtype: uint8 for pixels, float32 for states.
          action_dim: A >= 1.
        """
        self._capacity_steps = capacity_steps
        slots = ring_slots(capacity_steps, episode_steps)
        # These touch no pages yet, so memory use grows with the run.
        self._frames = np.empty((slots, *observation_shape), observation_dtype)
        self._actions = np.zeros((slots, action_dim), np.float32)
        self._rewards = np.zeros(slots, np.float32)
        self._discounts = np.zeros(slots, np.float32)
        self.clear()

    def clear(self, first_episode: int = 0) -> None:
        """Removes all episodes; the next one gets the number `first_episode`."""
        self._stored: dict[int, _Stored] = {}  # by number, the oldest first
        self._num_episodes_added = first_episode
        self._num_steps_stored = 0
        self._next_slot = 0
        # First slots and lengths, for sampling.
        self._starts = self._lengths = np.zeros(0, np.int64)

    @property
    def frames(self) -> np.ndarray:
        """The ring of frames, read-only: [num_slots, H, W, C] or [num_slots, S]."""
        ring = self._frames.view()
        ring.flags.writeable = False
        return ring

    @property
    def num_steps_stored(self) -> int:
        """Transitions in the replay."""
        return self._num_steps_stored

    @property
    def episodes(self) -> list[int]:
        """Numbers of the stored episodes, increasing, perhaps with gaps."""
        return list(self._stored)

    @property
    def num_episodes_added(self) -> int:
        """Episodes added or skipped so far: the number of the next one."""
        return self._num_episodes_added

    @property
    def oldest_episode(self) -> int:
        """Number of the oldest stored episode, or of the next one if there is none."""
        return next(iter(self._stored), self._num_episodes_added)

    def skip_episode(self) -> None:
        """Skips the next number, whose episode has been lost."""
        self._num_episodes_added += 1

    def add_episode(self, *, frames, actions, rewards, discounts) -> None:
        """Copies a whole episode, see `Episode`, and removes the oldest if necessary.

        Raises:
          ValueError: for a wrong shape or dtype, a number that is not finite, or an
            episode that is longer than the replay, which is then unchanged.
        """
        like = Episode(self._frames, self._actions, self._rewards, self._discounts)
        frames, actions, rewards, discounts = checked_episode(
            frames, actions, rewards, discounts, like=like
        )
        num_steps, length = len(rewards), len(self._frames)
        rule = f"at most {self._capacity_steps} steps"
        require(num_steps <= self._capacity_steps, "episode length", num_steps, rule)

        num_removed = 0
        while (
            self._num_steps_stored + num_steps > self._capacity_steps
            # Each episode has one frame more than it has steps.
            or self._num_steps_stored + len(self._stored) + num_steps + 1 > length
        ):
            oldest = self._stored.pop(self.oldest_episode)
            self._num_steps_stored -= oldest.num_steps
            num_removed += 1
        start = self._next_slot
        # In two pieces if it wraps around: slices copy faster than index lists.
        head = min(num_steps + 1, length - start)
        self._frames[start : start + head] = frames[:head]
        self._frames[: num_steps + 1 - head] = frames[head:]
        slots = (start + np.arange(num_steps)) % length
        self._actions[slots] = actions
        self._rewards[slots] = rewards
        self._discounts[slots] = discounts
        total_reward = rewards.sum(dtype=np.float64)
        self._stored[self._num_episodes_added] = _Stored(start, num_steps, total_reward)
        self._starts = np.append(self._starts[num_removed:], start)
        self._lengths = np.append(self._lengths[num_removed:], num_steps)
        self._next_slot = (start + num_steps + 1) % length
        self._num_steps_stored += num_steps
        self._num_episodes_added += 1

    def replace_rewards(self, index: int, rewards) -> None:
        """Replaces the rewards [T] of a stored episode.

        Raises:
          IndexError: if it is not stored.
          ValueError: for a wrong shape or dtype, or a number that is not finite.
        """
        slots = self.slots(index)[:-1]
        rewards = checked_values("rewards", rewards, self._rewards[slots])
        self._rewards[slots] = rewards
        total_reward = rewards.sum(dtype=np.float64)
        self._stored[index] = self._stored[index]._replace(total_reward=total_reward)

    def rewards(self, index: int) -> np.ndarray:
        """Returns a copy of the rewards of a stored episode, [T]."""
        return self._rewards[self.slots(index)[:-1]]

    def actions(self, index: int) -> np.ndarray:
        """Returns a copy of the actions of a stored episode, [T, A]."""
        return self._actions[self.slots(index)[:-1]]

    def mean_reward(self) -> float:
        """Returns the mean of all stored rewards; NaN if there are none."""
        if not self._stored:
            return math.nan
        total = sum(episode.total_reward for episode in self._stored.values())
        return float(total / self._num_steps_stored)

    def episode(self, index: int) -> Episode:
        """Returns a copy of a stored episode; IndexError if it is not stored."""
        slots = self.slots(index)
        return Episode(
            frames=self._frames[slots],
            actions=self._actions[slots[:-1]],
            rewards=self._rewards[slots[:-1]],
            discounts=self._discounts[slots[:-1]],
        )

    def slots(self, index: int) -> np.ndarray:
        """Returns an episode's indices in `frames`, [T + 1], or raises IndexError."""
        if index not in self._stored:
            raise IndexError(
                f"episode {index} is not stored: the replay holds"
                f" {len(self._stored)} of the episodes"
                f" {self.oldest_episode} to {self._num_episodes_added - 1}"
            )
        start, num_steps, _ = self._stored[index]
        return (start + np.arange(num_steps + 1)) % len(self._frames)


def ring_slots(capacity_steps: int, episode_steps: int) -> int:
    """Returns the slots of a ring: each episode has one frame more than steps."""
    return capacity_steps + math.ceil(capacity_steps / episode_steps)
