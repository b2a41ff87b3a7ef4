"""The interface of an imitation method: a few pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from jaxil.learner.state import LearnerParams
from jaxil.maths.types import Episode, ExpertBatch, ExpertEpisodes, Metrics, Window

RewarderState = Any  # a pytree, the method's own


class AgentView(NamedTuple):
    """What the agent's update has computed anyway, before it steps.

    Attributes:
      observation: augmented pixels. Shape [B, H, W, C].
      features: critic trunk features of them, without gradient. Shape [B, D].
      action: shape [B, A].
      unshifted: the pixels as they were stored. Shape [B, H, W, C].
    """

    observation: Array
    features: Array
    action: Array
    unshifted: Array


class Spec(NamedTuple):
    """Sizes that a method may need to make its state.

    Attributes:
      action_dim: A.
      feature_dim: D.
      num_demonstrations: K; 0 without demonstrations.
      expert_steps: N, decisions in a demonstration.
      observation_shape: (H, W, C), or (S,).
    """

    action_dim: int
    feature_dim: int
    num_demonstrations: int
    expert_steps: int
    observation_shape: tuple[int, ...]


class Rewarder(NamedTuple):
    """An imitation method, as (init, update) is an optimiser in optax.

    Attributes:
      init: (key, spec, learner) -> state. What the method learns or remembers;
        `learner` is there for methods that start as a copy of live networks.
      update: (state, learner, agent, expert, key) -> (state, metrics). Traced
        inside the learner's update step, on parameters from before that step.
        Methods that do not learn return the state as it is.
      rewards: (state, learner, episode, expert_episodes) -> (rewards [T], state).
        Called once for each episode, at its end; reward t belongs to the
        transition from observation t to observation t + 1.
      samples_expert: whether `update` reads an expert batch; without, none is
        drawn and `expert` is None.
      matches_episodes: whether `rewards` reads whole demonstrations; without,
        `expert_episodes` is None.
      summary: state -> scalars worth logging after an episode.
      relabel: (state, learner, window) -> rewards [B, n]. For methods that reward
        sampled transitions anew at each update; None where rewards are stored.
      rewards_changed: state -> whether an episode rewarded before the last call of
        `rewards` would get other rewards now: a bool or a bool array. None where
        rewards never change, or are not read because `relabel` replaces them.
      plan: (state, learner, episode, expert_episodes) -> the transport plan
        [T + 1, N + 1] behind `rewards`, for people to look at; None without one.
    """

    init: Callable[[Array, Spec, LearnerParams], RewarderState]
    update: Callable[
        [RewarderState, LearnerParams, AgentView, ExpertBatch | None, Array],
        tuple[RewarderState, Metrics],
    ]
    rewards: Callable[
        [RewarderState, LearnerParams, Episode, ExpertEpisodes | None],
        tuple[Array, RewarderState],
    ]
    samples_expert: bool
    matches_episodes: bool
    summary: Callable[[RewarderState], Metrics] = lambda state: {}
    relabel: Callable[[RewarderState, LearnerParams, Window], Array] | None = None
    rewards_changed: Callable[[RewarderState], Array | bool] | None = None
    plan: (
        Callable[[RewarderState, LearnerParams, Episode, ExpertEpisodes], Array] | None
    ) = None


def keep_state(
    state: RewarderState,
    learner: LearnerParams,
    agent: AgentView,
    expert: ExpertBatch | None,
    key: Array,
) -> tuple[RewarderState, Metrics]:
    """The `update` of a method that does not learn by gradients."""
    del learner, agent, expert, key
    return state, {}
