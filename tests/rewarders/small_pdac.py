"""A P-DAC rewarder small enough for tests; each setting is compiled once."""

import functools

import jax
import jax.numpy as jnp

from jaxil.learner.rewarder import AgentView
from jaxil.networks.agent import critic_features
from jaxil.rewarders import pdac
from tests.tiny_agent import NETWORKS, make_agent, make_spec, random_actions

STEPS, BATCH = 5, 8
SPEC = make_spec(expert_steps=4)


@functools.cache
def make_rewarder(frame_stack=1, sees_actions=False, shift_padding=0, num_components=0):
    rewarder = pdac.make_rewarder(
        make_agent(frame_stack, shift_padding),
        hidden_dim=16,
        learning_rate=3e-3,
        gradient_penalty=10.0,
        batch_size=BATCH,
        sees_actions=sees_actions,
        num_components=num_components,
    )
    return rewarder._replace(
        rewards=jax.jit(rewarder.rewards),
        update=jax.jit(rewarder.update),
        observe=jax.jit(rewarder.observe) if num_components else rewarder.observe,
    )


def make_view(params, frames, actions=None):
    features = critic_features(
        NETWORKS, params.encoder, params.critic, jnp.asarray(frames)
    )
    actions = random_actions(9, len(frames)) if actions is None else actions
    frames = jnp.asarray(frames)
    return AgentView(frames, features, jnp.asarray(actions), frames)
