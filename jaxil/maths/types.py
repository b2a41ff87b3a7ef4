"""Names for the values that travel between the floors.

Axes, everywhere in this project: B batch, T agent time, N expert time,
K demonstrations, H W C pixels (channels last, the stack folded into C),
S state vector, R representation, D feature, A action.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:  # host code imports this file, and jax takes a second
    from jax import Array

Params = Any  # a pytree of arrays, as flax makes it
Data = Any  # an array: NumPy's on the host, jax's inside jitted functions
Metrics = dict[str, "Array"]  # scalars, left on the device until they are logged


class Window(NamedTuple):
    """Every transition of n-step windows, for methods that reward them anew.

    Attributes:
      observation: uint8 [B, n, H, W, C], or float32 [B, n, S].
      action: shape [B, n, A].
      weight: what each one's reward counts for in the window's: gamma^k times the
        environment's discounts before it. Shape [B, n].
    """

    observation: Data
    action: Data
    weight: Data


class Batch(NamedTuple):
    """Sampled transitions, n environment decisions long.

    Attributes:
      observation: uint8 [B, H, W, C], or float32 [B, S] for state vectors.
      action: first action of each window, in [-1, 1]. Shape [B, A].
      reward: discounted sum of the window's rewards. Shape [B].
      discount: product of environment discounts and gamma^n. Shape [B].
      next_observation: observation after the window, like `observation`.
      window: all of the window's transitions; None for methods whose rewards are
        stored.
    """

    observation: Data
    action: Data
    reward: Data
    discount: Data
    next_observation: Data
    window: Window | None = None


class ExpertBatch(NamedTuple):
    """Observations sampled from the demonstrations.

    Attributes:
      observation: uint8 [B, H, W, C], or float32 [B, S].
      action: what the expert did there. Shape [B, A]. Read only by methods that
        say that they see actions.
    """

    observation: Data
    action: Data


class Episode(NamedTuple):
    """One finished episode of the agent, frames not stacked.

    Attributes:
      frames: uint8 [T + 1, H, W, 3], or float32 [T + 1, S]; the first one is the
        observation at reset.
      actions: shape [T, A].
      task_rewards: the environment's own rewards. Shape [T].
    """

    frames: Data
    actions: Data
    task_rewards: Data


class ExpertEpisodes(NamedTuple):
    """The demonstrations, frames not stacked.

    Attributes:
      frames: uint8 [K, N + 1, H, W, 3], or float32 [K, N + 1, S]. A shorter episode
        repeats its last frame.
      num_frames: how many of them are the episode's own. Shape [K].
      actions: shape [K, N, A]; [K, 0, 0] where they are not known.
    """

    frames: Data
    num_frames: Data
    actions: Data
