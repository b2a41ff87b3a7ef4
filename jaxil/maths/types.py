"""Types that several packages share; their arrays are NumPy's or jax's.

Axes, everywhere in this project: B batch, T agent time, N expert time,
K demonstrations, H W C pixels (channels last, the stack folded into C),
S state vector, R representation, D feature, A action, n steps of a window.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

Params = Any  # a pytree of arrays, from flax
Data = Any  # an array: NumPy's on the host, jax's inside jitted functions
Metrics = dict[str, Any]  # scalars, kept on the device until they are logged


class Window(NamedTuple):
    """All transitions of n-step windows, for methods that relabel samples.

    The observation after the window is the batch's `next_observation`.

    Attributes:
      observation: uint8 [B, n, H, W, C], or float32 [B, n, S].
      action: shape [B, n, A].
      weight: factor of each reward in the window's return: gamma^k times the
        environment's discounts before it. Shape [B, n].
    """

    observation: Data
    action: Data
    weight: Data


class Batch(NamedTuple):
    """Sampled transitions of n agent steps.

    Where frames are kept on the device, observations are indices of their F frames
    instead: int32 [B, F], those of a window [B, n, F], the oldest first.

    Attributes:
      observation: o_t, uint8 [B, H, W, C], or float32 [B, S] for state vectors.
      action: a_t, in [-1, 1]. Shape [B, A].
      reward: discounted sum of r_t ... r_{t+n-1}. Shape [B].
      discount: gamma^n times the environment's discounts. Shape [B].
      next_observation: o_{t+n}, like `observation`.
      successor: o_{t+1}, like `observation`; None unless the method asks for it.
      window: all transitions; None unless the method relabels.
    """

    observation: Data
    action: Data
    reward: Data
    discount: Data
    next_observation: Data
    successor: Data | None = None
    window: Window | None = None

    def map_observations(self, function: Callable[[Data], Data]) -> "Batch":
        """Returns the batch with `function` applied to all its observations."""
        successor, window = self.successor, self.window
        if window is not None:
            window = window._replace(observation=function(window.observation))
        return self._replace(
            observation=function(self.observation),
            next_observation=function(self.next_observation),
            successor=None if successor is None else function(successor),
            window=window,
        )


class ExpertBatch(NamedTuple):
    """Observations sampled from the demonstrations.

    Attributes:
      observation: uint8 [B, H, W, C], or float32 [B, S].
      action: the expert's. Shape [B, A]; [B, 0] where unknown. Read only by methods
        that declare that they see actions.
      successor: the next observation; None unless the method asks for it.
    """

    observation: Data
    action: Data
    successor: Data | None = None

    def map_observations(self, function: Callable[[Data], Data]) -> "ExpertBatch":
        """Returns the batch with `function` applied to all its observations."""
        successor = self.successor
        return self._replace(
            observation=function(self.observation),
            successor=None if successor is None else function(successor),
        )


class Episode(NamedTuple):
    """One finished episode, frames not stacked.

    Attributes:
      frames: uint8 [T + 1, H, W, 3], or float32 [T + 1, S]; the first one is the
        observation at reset.
      actions: shape [T, A].
      rewards: rewards[t] belongs to (o_t, a_t, o_{t+1}). The environment's, or in the
        replay the method's. Shape [T].
      discounts: the environment's: 0 at a true end, 1 at a time limit. Shape [T].
    """

    frames: Data
    actions: Data
    rewards: Data
    discounts: Data

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.actions)


class PaddedEpisode(NamedTuple):
    """An episode whose last frame, action, reward and discount may be repeated.

    Functions that are compiled for a shape get few shapes this way.

    Attributes:
      frames, actions, rewards, discounts: as in `Episode`, padded to T >= `num_steps`.
      num_steps: the episode's own steps; what follows is padding. Shape [].
    """

    frames: Data
    actions: Data
    rewards: Data
    discounts: Data
    num_steps: Data


AnyEpisode = Episode | PaddedEpisode


class ExpertEpisodes(NamedTuple):
    """The demonstrations, frames not stacked.

    Attributes:
      frames: uint8 [K, N + 1, H, W, 3], or float32 [K, N + 1, S]. A shorter episode
        repeats its last frame.
      num_frames: number of frames without the padding. Shape [K].
      actions: shape [K, N, A]; [K, 0, 0] if unknown.
    """

    frames: Data
    num_frames: Data
    actions: Data
