"""Stored episodes rewarded anew by the rewarder as it is now."""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
from jax import Array

from jaxil.learner.rewarder import Rewarder, RewarderState
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import Data, Episode, ExpertEpisodes

Refresh = Callable[
    [RewarderState, LearnerParams, Data, Data, Data, ExpertEpisodes | None], Array
]


def make_refresh(rewarder: Rewarder) -> Refresh:
    """Returns the function that recomputes the rewards of stored episodes.

        (rewarder state, learner, frames [N, ...], indices [E, T + 1],
         actions [E, T, A], expert episodes) -> rewards [E, T]

    Each row is what `rewarder.rewards` returns for that episode now. `indices` say
    where the frames of each episode are in `frames`; all episodes have one length.
    The rewarder's state does not change.

    Args:
      rewarder: its rewards must be a function of frames and actions: the task's own
        rewards are not stored.
    """

    def refresh(
        state: RewarderState,
        learner: LearnerParams,
        frames: Data,
        indices: Data,
        actions: Data,
        expert_episodes: ExpertEpisodes | None,
    ) -> Array:
        chex.assert_rank([frames, indices, actions], [{2, 4}, 2, 3])
        chex.assert_equal_shape_prefix([indices, actions], 1)
        num_steps = actions.shape[1]
        chex.assert_axis_dimension(indices, 1, num_steps + 1)
        frames = jnp.asarray(frames)

        def episode_rewards(stored: tuple[Array, Array]) -> Array:
            places, taken = stored
            unknown = jnp.full(num_steps, jnp.nan)
            episode = Episode(frames[places], taken, task_rewards=unknown)
            return rewarder.rewards(state, learner, episode, expert_episodes)[0]

        # One at a time: a batch of episodes would need gigabytes.
        stored = (jnp.asarray(indices), jnp.asarray(actions))
        return jax.lax.map(episode_rewards, stored)

    return refresh
