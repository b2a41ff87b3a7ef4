"""No reward at all: the control that every method has to beat."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.maths.types import AnyEpisode

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


def zero_rewards(state: Any, learner: Any, episode: AnyEpisode, *_: Any) -> Array:
    """Returns zeros [T]."""
    del state, learner
    return jnp.zeros_like(episode.rewards)
