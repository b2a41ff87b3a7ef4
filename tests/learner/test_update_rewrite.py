"""The update step against a plain rewrite of DrQ-v2."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxil.maths.types import Batch
from jaxil.networks.agent import apply
from tests.learner.small_learner import (
    ACTIONS,
    BATCH,
    LEARNING_RATE,
    NETWORKS,
    NOISE_CLIP,
    TAU,
    jitted,
    make_batch,
    make_learner,
    make_state,
    plain_shift,
)


def plain_agent(state) -> types.SimpleNamespace:
    """Parameters and optimisers as DrQ-v2 keeps them, stepped one by one."""
    names = ("encoder", "actor", "critic")
    return types.SimpleNamespace(
        **{name: getattr(state, name).params for name in names},
        target_critic=state.target_critic,
        opt_states={name: getattr(state, name).opt_state for name in names},
    )


def plain_update(agent, batch: Batch, key, number: int, mistake: str = ""):
    """Updates the agent in place by none of the code under test but its networks.

    `mistake` is one thing to do wrong, to see that the comparison would notice.
    """
    encoder, actor, critic = NETWORKS
    optimiser = optax.adam(LEARNING_RATE)
    shift_key, next_shift_key, target_key, actor_key, _ = jax.random.split(
        jax.random.fold_in(key, number), 5
    )
    std = 1.0 - number / 10.0
    observation = plain_shift(batch.observation, shift_key)
    next_observation = plain_shift(batch.next_observation, next_shift_key)

    def step(name, gradients):
        updates, agent.opt_states[name] = optimiser.update(
            gradients, agent.opt_states[name]
        )
        new = optax.apply_updates(getattr(agent, name), updates)
        setattr(agent, name, new)

    def noise(noise_key):
        bound = 9.0 if mistake == "noise not clipped" else NOISE_CLIP
        normal = jax.random.normal(noise_key, (BATCH, ACTIONS))
        return jnp.clip(std * normal, -bound, bound)

    # Critic and encoder.
    z_next = apply(encoder, agent.encoder, next_observation)
    mean = jnp.tanh(apply(actor, agent.actor, z_next))
    action = jnp.clip(mean + noise(target_key), -1 + 1e-6, 1 - 1e-6)
    bootstrap_from = (
        agent.critic if mistake == "target of live critic" else agent.target_critic
    )
    q1, q2 = apply(critic, bootstrap_from, z_next, action)
    target = batch.reward + batch.discount * jnp.minimum(q1, q2)

    def critic_loss(params):
        values = apply(
            critic,
            params["critic"],
            apply(encoder, params["encoder"], observation),
            batch.action,
        )
        return jnp.mean((values[0] - target) ** 2) + jnp.mean((values[1] - target) ** 2)

    z = apply(encoder, agent.encoder, observation)
    old_critic = agent.critic
    loss, gradients = jax.value_and_grad(critic_loss)(
        {"critic": agent.critic, "encoder": agent.encoder}
    )
    step("critic", gradients["critic"])
    step("encoder", gradients["encoder"])

    # Actor: new critic, old representation.
    judge = old_critic if mistake == "actor on old critic" else agent.critic
    if mistake == "actor on new representation":
        z = apply(encoder, agent.encoder, observation)

    def actor_loss(params):
        mean = jnp.tanh(apply(actor, params, z))
        action = mean + noise(actor_key)
        outside = jax.lax.stop_gradient(jnp.clip(action, -1 + 1e-6, 1 - 1e-6) - action)
        if mistake == "clamp stops the gradient":
            action = jnp.clip(action, -1 + 1e-6, 1 - 1e-6)
            outside = 0.0
        q1, q2 = apply(critic, judge, z, action + outside)
        return -jnp.mean(jnp.minimum(q1, q2))

    actor_value, gradients = jax.value_and_grad(actor_loss)(agent.actor)
    step("actor", gradients)

    # Target critic.
    tau = 1.0 if mistake == "target copied" else TAU
    agent.target_critic = jax.tree.map(
        lambda new, old: tau * new + (1.0 - tau) * old,
        agent.critic,
        agent.target_critic,
    )
    return {
        "critic/loss": loss,
        "critic/target": target.mean(),
        "actor/loss": actor_value,
    }


def distance(state, agent) -> float:
    ours, theirs = (
        [each.encoder, each.actor, each.critic, each.target_critic]
        for each in (plain_agent(state), agent)
    )
    differences = jax.tree.map(
        lambda a, b: float(np.abs(np.subtract(a, b)).max()), ours, theirs
    )
    return max(jax.tree.leaves(differences))


def compare(num_updates: int, mistake: str = "") -> float:
    """Runs both side by side; returns the largest difference of any parameter."""
    learner = make_learner()
    state = make_state(learner)
    # Means near the edge of the box, so that noise leads out of it.
    actor = jax.tree.map(lambda leaf: 1.5 * leaf, state.actor.params)
    state = state.replace(actor=state.actor.replace(params=actor))
    agent = plain_agent(state)
    for number in range(num_updates):
        batch = make_batch(number)
        expected = plain_update(agent, batch, state.key, number, mistake)
        state, metrics = jitted(learner)(state, batch, None)
        if not mistake:
            for name, value in expected.items():
                np.testing.assert_allclose(metrics[name], value, rtol=1e-4, atol=1e-5)
    return distance(state, agent)


def test_agrees_with_a_plain_rewrite():
    assert compare(3) < 1e-5


@pytest.mark.parametrize(
    "mistake",
    [
        "noise not clipped",
        "target of live critic",
        "actor on old critic",
        "actor on new representation",
        "clamp stops the gradient",
        "target copied",
    ],
)
def test_the_rewrite_would_show_a_mistake(mistake):
    assert compare(2, mistake) > 1e-4
