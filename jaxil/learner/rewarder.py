"""The interface of an imitation method: a few pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import chex
import jax
import jax.numpy as jnp
from jax import Array

from jaxil.learner.state import LearnerParams
from jaxil.maths import augmentation, stacking
from jaxil.maths.types import (
    AnyEpisode,
    Batch,
    Data,
    Episode,
    ExpertBatch,
    ExpertEpisodes,
    Metrics,
    PaddedEpisode,
)
from jaxil.networks.agent import AgentNetworks, critic_features

RewarderState = Any  # a pytree, the method's own


class AgentSpec(NamedTuple):
    """What a method is told about the agent when it is created.

    Attributes:
      networks: the agent's.
      frame_stack: frames in an observation.
      shift_padding: of the random shift, in pixels; 0 for no augmentation.
    """

    networks: AgentNetworks
    frame_stack: int
    shift_padding: int

    @property
    def feature_dim(self) -> int:
        """D, the width of the trunks."""
        return self.networks.actor.feature_dim

    def stack_frames(self, frames: Data) -> Array:
        """Returns the observations of an episode, given its frames."""
        return stacking.stack_frames(frames, frame_stack=self.frame_stack)

    def augment(self, observation: Data, key: Array) -> Array:
        """Returns observations [B, ...] after the random shift."""
        return augmentation.augment(observation, key, padding=self.shift_padding)

    def critic_features(self, learner: LearnerParams, observation: Data) -> Array:
        """Returns the critic trunk's features of observations: [B, ...] to [B, D]."""
        return critic_features(
            self.networks, learner.encoder, learner.critic, observation
        )


class AgentView(NamedTuple):
    """The agent's samples, with features from before the update's step.

    The last three are None unless the method has `samples_successors`.

    Attributes:
      observation: augmented pixels [B, H, W, C], or states [B, S].
      features: critic trunk features of `observation`, without gradient. Shape [B, D].
      action: shape [B, A].
      unshifted: the same as stored, without augmentation.
      successor: the observations one step later, augmented. Like `observation`.
      successor_features: features of `successor`. Like `features`.
      unshifted_successor: successors as stored, for methods that shift an observation
        and its successor alike. Like `unshifted`.
    """

    observation: Array
    features: Array
    action: Array
    unshifted: Array
    successor: Array | None = None
    successor_features: Array | None = None
    unshifted_successor: Array | None = None


class Spec(NamedTuple):
    """Sizes that a method may need to make its state.

    Attributes:
      action_dim: A.
      num_demonstrations: K; 0 without demonstrations.
      expert_steps: N, agent steps in a demonstration.
      observation_shape: (H, W, C), or (S,).
    """

    action_dim: int
    num_demonstrations: int
    expert_steps: int
    observation_shape: tuple[int, ...]


# Types of a rewarder's functions, by what they read.
Result = TypeVar("Result")
OfEpisode = Callable[
    [RewarderState, LearnerParams, AnyEpisode, ExpertEpisodes | None], Result
]
OfSamples = Callable[
    [RewarderState, LearnerParams, AgentView, ExpertBatch | None, Array], Result
]


class Rewarder(NamedTuple):
    """An imitation method as pure functions, like optax's (init, update).

    Attributes:
      rewards: (state, learner, episode, expert_episodes) -> rewards [T]; reward t
        belongs to the transition from observation t to observation t + 1.
      init: (key, spec, learner) -> state: what the method learns or remembers;
        `learner` is for methods that start as a copy of live networks.
      update: (state, learner, view, expert, key) -> (state, metrics). Traced inside
        the learner's update step, on parameters from before that step.
      observe: (state, learner, episode, expert_episodes) -> state. Called once for
        each episode, at its end and before it is rewarded.
      expert_batch_size: expert samples that `update` gets; 0: `expert` is None.
      matches_episodes: whether `observe` and `rewards` read whole demonstrations; if
        not, `expert_episodes` is None.
      samples_successors: whether samples of agent and expert include the observation
        one step later.
      ignores_padding: whether `observe`, `plan` and the first `episode.num_steps`
        rewards do not depend on what follows these steps. If so, all three get a
        `PaddedEpisode`, short ones with their last frame and action repeated, and are
        compiled for fewer lengths; `num_steps` is traced then. If not, they get an
        `Episode`.
      relabel: (state, learner, batch) -> rewards [B, n], for methods that reward each
        batch by the current state; `batch` has its window. None where rewards are
        stored.
      rewards_changed: state -> whether rewards from before the last `observe` are
        stale. None where stored rewards never change.
      actor_loss: (state, learner, view, expert, key) -> scalar, added to the actor's
        loss and differentiated with respect to `learner.actor`; encoder and critic are
        those after this update's step. None if there is no such term.
      plan: (state, learner, episode, expert_episodes) -> the transport plan
        [T + 1, N + 1] behind `rewards`, for reports, and the index of its
        demonstration. None if there is no plan.
      summary: state -> scalars worth logging after an episode.
    """

    rewards: OfEpisode[Array]
    init: Callable[[Array, Spec, LearnerParams], RewarderState] = lambda *_: ()
    update: OfSamples[tuple[RewarderState, Metrics]] = lambda state, *_: (state, {})
    observe: OfEpisode[RewarderState] = lambda state, *_: state
    expert_batch_size: int = 0
    matches_episodes: bool = False
    samples_successors: bool = False
    ignores_padding: bool = False
    relabel: Callable[[RewarderState, LearnerParams, Batch], Array] | None = None
    rewards_changed: Callable[[RewarderState], Array | bool] | None = None
    actor_loss: OfSamples[Array] | None = None
    plan: (
        Callable[
            [RewarderState, LearnerParams, AnyEpisode, ExpertEpisodes],
            tuple[Array, Array],
        ]
        | None
    ) = None
    summary: Callable[[RewarderState], Metrics] = lambda state: {}


def make_refresh(rewarder: Rewarder) -> Callable[..., Array]:
    """Returns the function that recomputes the rewards of stored episodes.

        (rewarder state, learner, frames [M, ...], indices [E, T + 1],
         actions [E, T, A], their numbers of steps [E], expert episodes)
         -> rewards [E, T]

    Each row is what `rewarder.rewards` returns for that episode now. `indices` say
    where each episode's frames are in `frames`; all episodes are padded to one length.

    Args:
      rewarder: its rewards must depend on frames and actions alone, since task rewards
        are not stored.
    """

    def refresh(
        state: RewarderState,
        learner: LearnerParams,
        frames: Data,
        indices: Data,
        actions: Data,
        num_steps: Data,
        expert_episodes: ExpertEpisodes | None,
    ) -> Array:
        stored = tuple(jnp.asarray(each) for each in (indices, actions, num_steps))
        chex.assert_rank([frames, *stored], [{2, 4}, 2, 3, 1])
        chex.assert_equal_shape_prefix(stored, 1)
        length = actions.shape[1]
        chex.assert_axis_dimension(indices, 1, length + 1)
        frames = jnp.asarray(frames)
        unknown = jnp.full(length, jnp.nan)

        def episode_rewards(stored: tuple[Array, Array, Array]) -> Array:
            frame_indices, taken, steps = stored
            parts = frames[frame_indices], taken, unknown, unknown
            episode = Episode(*parts)
            if rewarder.ignores_padding:
                episode = PaddedEpisode(*parts, steps)
            return rewarder.rewards(state, learner, episode, expert_episodes)

        # One at a time: a batch of episodes would need gigabytes.
        return jax.lax.map(episode_rewards, stored)

    return refresh
