"""A world for methods that clone inferred actions, and learners small enough for it."""

import jax
import numpy as np
import optax

from jaxil.learner.rewarder import AgentSpec, Spec
from jaxil.learner.update import Learner, init_train_state
from jaxil.maths.types import Batch, ExpertBatch
from tests.tiny_agent import make_tiny_networks

STATE_DIM, SIDE = 3, 8


def learner_of(make_rewarder, observation, shift_padding, settings):
    networks = make_tiny_networks(
        feature_dim=16, hidden_dim=32, observation=observation
    )
    agent = AgentSpec(networks, 1, shift_padding)
    return learner_with(networks, make_rewarder(agent, **settings), shift_padding)


def learner_with(networks, rewarder, shift_padding):
    return Learner(
        networks=networks,
        rewarder=rewarder,
        learning_rate=3e-3,
        critic_target_tau=0.01,
        noise_clip=0.3,
        shift_padding=shift_padding,
        pre_tanh_penalty=0.0,
        exploration_std=optax.constant_schedule(0.1),
    )


def state_of(learner, observation):
    shape = (STATE_DIM,) if observation == "state" else (SIDE, SIDE, 3)
    dtype = np.float32 if observation == "state" else np.uint8
    spec = Spec(2, num_demonstrations=1, expert_steps=4, observation_shape=shape)
    return init_train_state(learner, jax.random.key(0), np.zeros(shape, dtype), spec)


def moved(observation, action):
    """A world in which an action moves two of three coordinates."""
    return observation + np.pad(action, ((0, 0), (1, 0))).astype(np.float32)


def play(rng, size=32):
    """The agent's transitions: states and actions are uniform."""
    observation = rng.uniform(-1, 1, (size, STATE_DIM)).astype(np.float32)
    action = rng.uniform(-1, 1, (size, 2)).astype(np.float32)
    unread = np.full(size, np.nan, np.float32)
    successor = moved(observation, action)
    return Batch(observation, action, unread, unread, observation, successor)


def expert_actions(observation):
    """What the expert does: it goes back to the middle."""
    return -0.8 * observation[:, 1:]


def demonstrations(rng, size=32):
    """The expert's transitions; its actions are not told."""
    observation = rng.uniform(-1, 1, (size, STATE_DIM)).astype(np.float32)
    successor = moved(observation, expert_actions(observation))
    untold = np.full((size, 2), np.nan, np.float32)
    return ExpertBatch(observation, untold, successor)
