"""Cloning of inferred actions beside the rewards of P-DAC, of P-SIL, and of others."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.learner.policy import make_mean_action
from jaxil.learner.rewarder import AgentView, Rewarder
from jaxil.learner.update import make_update_step
from jaxil.maths import cloning
from jaxil.networks.agent import apply
from jaxil.networks.inverse_model import InverseModels
from jaxil.rewarders.inferred_actions import with_cloning
from jaxil.rewarders.zero import zero_rewards
from tests.rewarders.small_cloning import (
    BATCH,
    KINDS,
    OF_CLONING,
    assert_same,
    compiled,
    differ,
    given,
    make_agent,
    make_batch,
    make_expert,
    make_learner,
    make_methods,
    make_state,
    observations,
)
from tests.rewarders.small_world import (
    demonstrations,
    expert_actions,
    play,
    record_shifts,
)
from tests.tiny_agent import random_actions

# The term ----------------------------------------------------------------------


def make_term(trust, models=None, **changes):
    """Returns the term's function of the actor, and its parts computed here."""
    own: dict[str, Any] = OF_CLONING | {"trust": trust} | changes
    inner = Rewarder(zero_rewards)
    ours, agent = with_cloning(inner, make_agent(), **own), make_agent()
    state = make_state(make_learner(ours))
    batch, expert = make_batch(), make_expert(own["num_pairs"])
    params, networks = state.params, agent.networks
    if models is not None:
        state = state.replace(rewarder=state.rewarder.replace(models=models(state)))
    z = apply(networks.encoder, params.encoder, batch.observation)
    features = apply(networks.critic, params.critic, z, method=networks.critic.features)
    view = AgentView(batch.observation, features, batch.action, batch.observation)
    model = InverseModels(networks.encoder, 16, own["head_dim"], 2, own["num_models"])
    inferred = apply(
        model, state.rewarder.models.params, expert.observation, expert.successor
    )
    z_expert = apply(networks.encoder, params.encoder, expert.observation)
    policy = jnp.tanh(apply(networks.actor, params.actor, z_expert))
    label = jnp.mean(inferred, axis=0)
    taken = apply(networks.critic, params.critic, z, batch.action)
    better, chosen = (
        np.min(apply(networks.critic, params.critic, z_expert, a), axis=0)
        for a in (label, policy)
    )
    parts = {
        "inferred": np.asarray(inferred),
        "squares": np.mean((np.asarray(policy) - np.asarray(label)) ** 2, axis=1),
        "scale": np.mean(np.abs(np.min(taken, axis=0))),
        "prefers": better > chosen,
    }

    def term(actor):
        learner = params._replace(actor=actor)
        key = jax.random.key(5)
        assert ours.actor_loss is not None
        return ours.actor_loss(state.rewarder, learner, view, expert, key)

    return term, params.actor, parts


@pytest.mark.parametrize("trust", ["agreement", "q_filter", "none"])
def test_the_term_is_the_trusted_squared_distance_in_units_of_values(trust):
    term, actor, parts = make_term(trust, num_pairs=32)
    variance = np.sum(np.var(parts["inferred"], axis=0), axis=1)
    weights = {
        "agreement": np.exp(-variance / 0.05),
        "q_filter": parts["prefers"].astype(float),
        "none": np.ones(32),
    }[trust]
    if trust != "none":
        assert np.ptp(weights) > 0.1
    expected = 0.4 * parts["scale"] * np.mean(weights * parts["squares"])
    np.testing.assert_allclose(compiled(term)(actor), expected, rtol=1e-4)


def test_identical_models_are_trusted_wholly():
    def alike(state):
        def first(path, x):
            is_head = "VmapMLP_0" in jax.tree_util.keystr(path)
            return jnp.broadcast_to(x[:1], x.shape) if is_head else x

        models = state.rewarder.models
        params = jax.tree_util.tree_map_with_path(first, models.params)
        assert differ(params, models.params)
        return models.replace(params=params)

    by_agreement, actor, _ = make_term("agreement", models=alike)
    wholly, _, _ = make_term("none", models=alike)
    trusted, full = (compiled(each)(actor) for each in (by_agreement, wholly))
    np.testing.assert_allclose(trusted, full, rtol=1e-6)
    apart, _, _ = make_term("agreement")
    alone, _, _ = make_term("none")
    assert compiled(apart)(actor) < 0.99 * compiled(alone)(actor)


def test_the_term_pulls_the_policy_towards_the_label():
    term, actor, _ = make_term("none")
    before, gradients = compiled(jax.value_and_grad(term))(actor)
    assert before > 0
    moved = jax.tree.map(lambda x, g: x - 1e-2 * g, actor, gradients)
    assert compiled(term)(moved) < before


# Learning ----------------------------------------------------------------------


def rewarded_play(rng):
    """The agent's transitions; every action earns the same."""
    batch = play(rng)
    return batch._replace(
        reward=np.ones(32, np.float32),
        discount=np.full(32, 0.5, np.float32),
        next_observation=batch.successor,
    )


@functools.cache
def learned(weight, trust):
    """Returns how far the policy is from the expert's actions, and last metrics."""
    own: dict[str, Any] = OF_CLONING | {"num_pairs": 32, "head_dim": 32}
    own |= {"weight": weight, "trust": trust}
    learner = make_learner(with_cloning(Rewarder(zero_rewards), make_agent(), **own))
    rng, state = np.random.default_rng(0), make_state(learner)
    step = jax.jit(make_update_step(learner))
    metrics = {}
    for _ in range(600):
        state, metrics = step(state, rewarded_play(rng), demonstrations(rng))
    seen = demonstrations(rng).observation
    copied = make_mean_action(learner.networks)(
        state.encoder.params, state.actor.params, seen
    )
    distance = np.mean(np.square(copied - expert_actions(seen)))
    return distance / np.mean(np.square(expert_actions(seen))), metrics


@pytest.mark.parametrize("trust", ["agreement", "none"])
def test_the_policy_copies_actions_that_nobody_told_it(trust):
    error, metrics = learned(10.0, trust)
    assert metrics["inverse_model/error"] < 0.03  # of a mean square of 0.67
    assert metrics["inverse_model/agreement"] > 0.9
    assert error < 0.1
    without, _ = learned(0.0, "agreement")
    assert without > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_the_inverse_models_learn_from_the_agent_alone(kind):
    """Other demonstrations change the policy, and nothing of the inverse models."""
    _, ours = make_methods("psil", kind, shift_padding=1)
    learner = make_learner(ours, kind, 1)
    state, step = make_state(learner, kind), compiled(make_update_step(learner))
    one, other = (
        step(state, make_batch(kind), make_expert(6, kind, seed))[0]
        for seed in (10, 20)
    )
    jax.tree.map(
        np.testing.assert_array_equal, one.rewarder.models, other.rewarder.models
    )
    assert differ(one.rewarder.models.params, state.rewarder.models.params)
    assert differ(one.actor.params, other.actor.params)
    for name in ("encoder", "critic", "target_critic"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(one, name), getattr(other, name)
        )


@pytest.mark.parametrize(
    ("name", "trust"), [("pdac", "agreement"), ("psil", "q_filter")]
)
def test_the_experts_actions_change_nothing(name, trust):
    _, ours = make_methods(name, trust=trust)
    learner = make_learner(ours)
    state, step = make_state(learner), compiled(make_update_step(learner))
    untold = make_expert(ours.expert_batch_size)
    told = untold._replace(action=np.zeros_like(untold.action))
    (first, metrics), (second, _) = (
        step(state, make_batch(), expert) for expert in (untold, told)
    )
    assert all(np.isfinite(value) for value in metrics.values())
    assert_same(first.params, second.params)
    assert_same(first.rewarder, second.rewarder)


def test_both_observations_of_a_pair_are_shifted_alike(monkeypatch):
    """If nothing moves, the inverse models must see that nothing moves."""
    seen = record_shifts(monkeypatch)
    _, ours = make_methods("psil", "pixels", shift_padding=2)
    pixels, features = observations(0, "pixels", BATCH), jnp.zeros((BATCH, 16))
    state = make_state(make_learner(ours, "pixels", 2), "pixels")
    view = AgentView(
        pixels,
        features,
        jnp.asarray(random_actions(0, BATCH)),
        pixels,
        successor=jnp.zeros_like(pixels),  # not read: it has another shift
        successor_features=features,
        unshifted_successor=pixels,
    )

    def shifted(expert):
        key = jax.random.key(0)
        ours.update(state.rewarder, state.params, view, expert, key)
        return [x for x in seen if x.shape[-1] == 6]

    (pair,) = compiled(shifted)(make_expert(6, "pixels"))
    np.testing.assert_array_equal(pair[..., :3], pair[..., 3:])
    assert np.any(pair[..., :3] != pixels)


def test_metrics_are_error_and_agreement_of_the_models():
    ours, state, view, expert = given(Rewarder(zero_rewards))
    model = InverseModels(make_agent().networks.encoder, 16, 16, 2, 3)
    params = state.rewarder.models.params
    inferred = apply(model, params, view.unshifted, view.unshifted_successor)
    labels = apply(model, params, expert.observation, expert.successor)
    assert inferred.shape == (3, BATCH, 2)
    assert np.all(np.ptp(np.asarray(labels), axis=0) > 0)  # the heads start apart
    _, metrics = compiled(ours.update)(
        state.rewarder, state.params, view, expert, jax.random.key(0)
    )
    squares = np.sum((np.asarray(inferred) - view.action) ** 2, axis=2)
    np.testing.assert_allclose(
        metrics["inverse_model/error"], np.mean(squares), rtol=1e-5
    )
    trust = np.exp(-np.asarray(cloning.disagreement(labels)) / 0.05)
    np.testing.assert_allclose(
        metrics["inverse_model/agreement"], np.mean(trust), rtol=1e-5
    )
