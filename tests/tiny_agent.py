"""An agent small enough for tests, its parameters, and pixels for it to look at."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import Episode, ExpertEpisodes
from jaxil.networks.agent import AgentNetworks, apply, make_agent_networks

SIDE, ACTION_DIM, FEATURE_DIM = 12, 2, 5
# For methods that share no network with the agent.
NOBODY = LearnerParams(None, None, None)


def make_tiny_networks(**changes) -> AgentNetworks:
    """Returns networks of one convolution, or of other sizes."""
    sizes: dict[str, Any] = {
        "action_dim": ACTION_DIM,
        "feature_dim": FEATURE_DIM,
        "hidden_dim": 6,
        "observation": "pixels",
        "channels": (4,),
        "kernel_sizes": (4,),
        "strides": (4,),
        "contrast": 1.0,
        "mean": 0.5,
    }
    return make_agent_networks(**(sizes | changes))


NETWORKS = make_tiny_networks()


def make_agent(frame_stack: int = 1, shift_padding: int = 0) -> AgentSpec:
    """Returns what methods are told of the agent of `NETWORKS`."""
    return AgentSpec(NETWORKS, frame_stack, shift_padding)


def make_spec(
    *, expert_steps: int, num_demonstrations: int = 2, frame_stack: int = 1
) -> Spec:
    """Returns the sizes that rewarders for `NETWORKS` are told."""
    shape = (SIDE, SIDE, 3 * frame_stack)
    return Spec(ACTION_DIM, num_demonstrations, expert_steps, shape)


@functools.cache
def make_params(seed: int, frame_stack: int = 1) -> LearnerParams:
    """Returns parameters of `NETWORKS`; they must not be changed in place."""
    return _init_params(jax.random.key(seed), frame_stack)


@functools.partial(jax.jit, static_argnums=1)  # one program instead of a hundred
def _init_params(key: jax.Array, frame_stack: int) -> LearnerParams:
    keys = jax.random.split(key, 3)
    images = jnp.zeros((1, SIDE, SIDE, 3 * frame_stack), jnp.uint8)
    encoder = NETWORKS.encoder.init(keys[0], images)
    z = apply(NETWORKS.encoder, encoder, images)
    actor = NETWORKS.actor.init(keys[1], z)
    critic = NETWORKS.critic.init(keys[2], z, jnp.zeros((1, ACTION_DIM)))
    return LearnerParams(encoder, actor, critic)


def random_frames(seed: int, *shape: int, low: int = 0, high: int = 256) -> np.ndarray:
    """Returns noise in [low, high), uint8 [*shape, SIDE, SIDE, 3]."""
    rng = np.random.default_rng(seed)
    return rng.integers(low, high, (*shape, SIDE, SIDE, 3), dtype=np.uint8)


def random_actions(seed: int, count: int) -> np.ndarray:
    """Returns actions in [-1, 1], float32 [count, A]."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, ACTION_DIM)).astype(np.float32)


def make_episode(frames: np.ndarray, actions: np.ndarray | None = None) -> Episode:
    """Returns an episode of T + 1 frames that earned nothing."""
    steps = len(frames) - 1
    if actions is None:
        actions = np.zeros((steps, ACTION_DIM), np.float32)
    return Episode(frames, actions, np.zeros(steps), np.ones(steps))


def make_experts(frames: np.ndarray) -> ExpertEpisodes:
    """Returns demonstrations of one length, whose actions are not known.

    Args:
      frames: shape [K, N + 1, ...].
    """
    count, length = frames.shape[:2]
    return ExpertEpisodes(frames, np.full(count, length), np.zeros((count, 0, 0)))


def make_play(rewarder: Rewarder):
    """Returns what a run does at an episode's end, compiled once.

    (state, learner, episode, experts) -> (rewards [T], state).
    """

    def play(state, learner, episode, experts):
        state = rewarder.observe(state, learner, episode, experts)
        return rewarder.rewards(state, learner, episode, experts), state

    return jax.jit(play)
