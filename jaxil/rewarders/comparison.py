"""Rewarders that compare a whole episode with the demonstrations."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxil.learner.rewarder import Rewarder
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import AnyEpisode, ExpertEpisodes

_COST_FLOOR = 1e-8  # keeps the scale finite if the first episode costs nothing

# (agent features [T + 1, D], their number without padding [], expert features
# [K, N + 1, D], their numbers without padding [K]) -> rewards [T + 1] of o_0 ... o_T, 0
# for padding, or a plan [T + 1, N + 1] and the index of its demonstration.
Compare = Callable[[Array, Array, Array, Array], Any]


def make_comparing_rewarder(
    *,
    init: Callable[..., Any],
    update_features: Callable[[Any, LearnerParams, AnyEpisode, ExpertEpisodes], Any],
    embed: Callable[[Any, Array], Array],
    compare: Compare,
    plan: Compare | None = None,
    return_scale: float | None = None,
    rewards_changed: Callable[[Any], Any] | None = None,
) -> Rewarder:
    """Returns a rewarder of whole episodes under some features.

    Its state is a PyTreeNode with at least `expert_features`, the demonstrations'
    features [K, N + 1, D], and `scale`, the factor on rewards [], which is 0 before the
    first episode, or always 1 without `return_scale`.

    Args:
      init: see `Rewarder`.
      update_features: (state, learner, episode, demonstrations) -> state; may change
        what `embed` returns, at each episode's end and before it is rewarded.
      embed: (state, frames [T + 1, ...]) -> features [T + 1, D].
      compare: features to rewards, before scaling.
      plan: the transport plan behind them; None without one.
      return_scale: the first episode's rewards are scaled to return minus this, and
        that scale stays; None: rewards are not scaled.
      rewards_changed: see `Rewarder`.
    """

    def compared(
        state: Any, episode: AnyEpisode, expert_episodes: ExpertEpisodes | None
    ) -> tuple[Array, Array, Array, Array]:
        """Returns what `compare` and `plan` take."""
        assert expert_episodes is not None
        return (
            embed(state, jnp.asarray(episode.frames)),
            jnp.asarray(episode.num_steps) + 1,
            state.expert_features,
            jnp.asarray(expert_episodes.num_frames),
        )

    def unscaled(
        state: Any, episode: AnyEpisode, expert_episodes: ExpertEpisodes | None
    ) -> Array:
        # Reward t is that of o_{t+1}.
        return compare(*compared(state, episode, expert_episodes))[1:]

    def observe(
        state: Any,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes | None,
    ) -> Any:
        assert expert_episodes is not None
        state = update_features(state, learner, episode, expert_episodes)
        if return_scale is None:
            return state

        def first(wanted: float) -> Array:
            cost = -jnp.sum(unscaled(state, episode, expert_episodes))
            return wanted / jnp.maximum(cost, _COST_FLOOR)

        scale = jax.lax.cond(
            state.scale > 0.0, lambda wanted: state.scale, first, return_scale
        )
        return state.replace(scale=scale)

    def rewards(state: Any, learner: LearnerParams, *episodes: Any) -> Array:
        del learner
        return state.scale * unscaled(state, *episodes)

    def plan_of(state: Any, learner: LearnerParams, *episodes: Any) -> Any:
        del learner
        assert plan is not None
        return plan(*compared(state, *episodes))

    return Rewarder(
        rewards,
        init,
        observe=observe,
        matches_episodes=True,
        ignores_padding=True,
        rewards_changed=rewards_changed,
        plan=None if plan is None else plan_of,
        summary=lambda state: (
            {} if return_scale is None else {"sinkhorn/scale": state.scale}
        ),
    )


def embed_demonstrations(
    embed: Callable[[Any, Array], Array], state: Any, expert_episodes: ExpertEpisodes
) -> Any:
    """Returns the state with the demonstrations' features, as `embed` sees them now."""
    # One demonstration at a time: all at once would need gigabytes.
    features = jax.lax.map(
        functools.partial(embed, state), jnp.asarray(expert_episodes.frames)
    )
    return state.replace(expert_features=features)
