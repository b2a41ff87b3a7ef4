"""No reward at all: the control that every method has to beat."""

import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder, RewarderState
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import AnyEpisode, ExpertEpisodes

METHOD = methods.Method(
    name="zero",
    label="no reward",
    about="no reward at all: the control",
    colour="#888888",
    rank=7,
    uses_demonstrations=False,
)


def make_rewarder(agent: AgentSpec) -> Rewarder:
    """Returns a rewarder of zeros."""
    del agent
    return Rewarder(zero_rewards, ignores_padding=True)


def zero_rewards(
    state: RewarderState,
    learner: LearnerParams,
    episode: AnyEpisode,
    expert_episodes: ExpertEpisodes | None,
) -> Array:
    """Returns zeros [T]."""
    del state, learner, expert_episodes
    return jnp.zeros_like(episode.rewards)
