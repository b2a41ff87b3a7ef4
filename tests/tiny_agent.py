"""An agent small enough for tests, its parameters, and pixels for it to look at."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.learner.rewarder import Spec
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import Episode
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


def make_spec(
    *, expert_steps: int, num_demonstrations: int = 2, frame_stack: int = 1
) -> Spec:
    """Returns the sizes that rewarders for `NETWORKS` are told."""
    shape = (SIDE, SIDE, 3 * frame_stack)
    return Spec(ACTION_DIM, FEATURE_DIM, num_demonstrations, expert_steps, shape)


@functools.cache
def make_params(seed: int, frame_stack: int = 1) -> LearnerParams:
    """Returns parameters of `NETWORKS`; they must not be changed in place."""
    keys = jax.random.split(jax.random.key(seed), 3)
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


def make_episode(frames: np.ndarray) -> Episode:
    """Returns an episode of T + 1 frames in which nothing was done or earned."""
    steps = len(frames) - 1
    return Episode(frames, np.zeros((steps, ACTION_DIM), np.float32), np.zeros(steps))
