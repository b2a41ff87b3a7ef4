"""Rewards that need no demonstrations: the task's own, and none at all."""

import jax.numpy as jnp
from jax import Array

from jaxil.learner.rewarder import Rewarder, RewarderState, Spec, keep_state
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import Episode, ExpertEpisodes


def make_task_rewarder() -> Rewarder:
    """Returns the environment's own reward, which makes the learner DrQ-v2."""

    def rewards(
        state: RewarderState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes | None,
    ) -> tuple[Array, RewarderState]:
        del learner, expert_episodes
        return episode.task_rewards, state

    return Rewarder(
        _no_state, keep_state, rewards, samples_expert=False, matches_episodes=False
    )


def make_zero_rewarder() -> Rewarder:
    """Returns zero everywhere: the control that any method has to beat."""

    def rewards(
        state: RewarderState,
        learner: LearnerParams,
        episode: Episode,
        expert_episodes: ExpertEpisodes | None,
    ) -> tuple[Array, RewarderState]:
        del learner, expert_episodes
        return jnp.zeros_like(episode.task_rewards), state

    return Rewarder(
        _no_state, keep_state, rewards, samples_expert=False, matches_episodes=False
    )


def _no_state(key: Array, spec: Spec, learner: LearnerParams) -> tuple[()]:
    del key, spec, learner
    return ()
