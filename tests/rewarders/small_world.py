"""A world for methods that clone actions, and learners small enough for it."""

import jax
import numpy as np
import optax

from jaxil.learner.rewarder import AgentSpec, Spec
from jaxil.learner.update import Learner, init_train_state
from jaxil.maths import augmentation
from jaxil.maths.types import Batch, ExpertBatch
from tests.tiny_agent import make_tiny_networks

STATE_DIM, SIDE = 3, 8


def learner_of(make_rewarder, observation, shift_padding, settings):
    networks = make_tiny_networks(
        feature_dim=16, hidden_dim=32, observation=observation
    )
    agent = AgentSpec(networks, 1, shift_padding)
    return learner_with(networks, make_rewarder(agent, **settings), shift_padding)


def learner_with(networks, rewarder, shift_padding, learning_rate=3e-3):
    return Learner(
        networks=networks,
        rewarder=rewarder,
        learning_rate=learning_rate,
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


def pictures(seed=0):
    """Pixels of play and demonstrations in which nothing moves."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (32, SIDE, SIDE, 3), dtype=np.uint8)
    action, unread = np.zeros((32, 2), np.float32), np.full(32, np.nan, np.float32)
    batch = Batch(pixels, action, unread, unread, pixels, pixels)
    return batch, ExpertBatch(pixels, action, pixels)


def record_shifts(monkeypatch):
    """Returns a list to which `augmentation.augment` adds all that it returns."""
    returned, real = [], augmentation.augment

    def augment(observation, key, *, padding):
        returned.append(real(observation, key, padding=padding))
        return returned[-1]

    monkeypatch.setattr(augmentation, "augment", augment)
    return returned
