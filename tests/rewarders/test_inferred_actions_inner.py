"""The method that cloning is added to is left as it is."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.learner.rewarder import Rewarder, Spec
from jaxil.learner.update import make_update_step
from jaxil.rewarders.zero import zero_rewards
from tests.rewarders.small_cloning import (
    assert_same,
    compiled,
    given,
    make_batch,
    make_expert,
    make_learner,
    make_methods,
    make_state,
    observations,
)
from tests.rewarders.small_world import STATE_DIM
from tests.tiny_agent import make_episode, make_experts


@pytest.mark.parametrize(
    ("name", "kind"), [("pdac", "state"), ("pdac", "pixels"), ("psil", "state")]
)
def test_without_weight_the_agent_learns_as_with_the_inner_method(name, kind):
    inner, ours = make_methods(name, kind, shift_padding=1, weight=0.0)
    batch, size = make_batch(kind), max(inner.expert_batch_size, 6)
    expert = make_expert(size, kind)
    plain, cloned = (make_learner(each, kind, 1) for each in (inner, ours))
    states = make_state(plain, kind), make_state(cloned, kind)
    assert_same(states[1].rewarder.inner, states[0].rewarder)
    of_inner = expert._replace(successor=None) if inner.expert_batch_size else None
    step, other = (compiled(make_update_step(each)) for each in (plain, cloned))
    for _ in range(3):
        states = (
            step(states[0], batch._replace(successor=None), of_inner)[0],
            other(states[1], batch, expert)[0],
        )
    assert_same(states[1].params, states[0].params, atol=1e-6)
    assert_same(states[1].rewarder.inner, states[0].rewarder, atol=1e-6)


@pytest.mark.parametrize("name", ["pdac", "psil"])
def test_the_inner_method_rewards_plans_and_remembers_as_it_does_alone(name):
    inner, ours = make_methods(name)
    params = make_state(make_learner(inner)).params
    spec = Spec(2, 2, expert_steps=4, observation_shape=(STATE_DIM,))
    episode = make_episode(observations(0, "state", 6))
    experts = make_experts(observations(1, "state", 2, 5))

    def after_an_episode(rewarder):
        state = rewarder.init(jax.random.key(3), spec, params)
        state = rewarder.observe(state, params, episode, experts)
        return state, rewarder.rewards(state, params, episode, experts)

    states, rewards = zip(
        *(compiled(lambda r=r: after_an_episode(r))() for r in (inner, ours))
    )
    assert_same(states[1].inner, states[0])
    assert np.ptp(np.asarray(rewards[0])) > 0
    np.testing.assert_allclose(rewards[1], rewards[0], rtol=1e-6)
    assert ours.matches_episodes == inner.matches_episodes
    assert ours.relabel is None
    assert ours.rewards_changed is not None
    assert inner.rewards_changed is not None
    assert ours.rewards_changed(states[1]) == inner.rewards_changed(states[0])
    assert ours.summary(states[1]) == inner.summary(states[0])
    assert (ours.plan is None) == (inner.plan is None) == (name == "pdac")
    if inner.plan is not None:
        plans = (
            compiled(each.plan)(state, params, episode, experts)
            for each, state in zip((ours, inner), states[::-1])
        )
        assert_same(*plans, atol=1e-6)


def recorder(calls, **changes):
    """A method that returns or notes what it is given."""

    def update(state, learner, view, expert, key):
        return state + 1, {"view": view, "expert": expert}

    def loss(state, learner, view, expert, key):
        calls.append((view, expert))
        return 7.0 * jnp.mean(learner.actor["params"]["head"]["output"]["bias"])

    return Rewarder(
        zero_rewards,
        lambda key, spec, learner: jnp.zeros(()),
        update,
        actor_loss=loss,
        relabel=lambda state, learner, batch: state + batch,
        **changes,
    )


@pytest.mark.parametrize(
    ("wanted", "num_pairs", "successors"), [(0, 6, False), (4, 6, True), (9, 6, False)]
)
def test_the_inner_method_is_given_what_it_asked_for(wanted, num_pairs, successors):
    calls = []
    inner = recorder(calls, expert_batch_size=wanted, samples_successors=successors)
    ours, state, view, expert = given(inner, num_pairs)
    assert ours.expert_batch_size == max(wanted, num_pairs)
    assert ours.samples_successors
    assert ours.actor_loss is not None
    key, params = jax.random.key(0), state.params
    after, metrics = compiled(ours.update)(state.rewarder, params, view, expert, key)
    assert after.inner == 1
    compiled(ours.actor_loss)(state.rewarder, params, view, expert, key)
    for seen, samples in ((metrics["view"], metrics["expert"]), *calls):
        assert (seen.successor is not None) == successors
        assert (seen.unshifted_successor is not None) == successors
        assert (samples is not None) == bool(wanted)
        if wanted:
            assert samples.observation.shape == (wanted, STATE_DIM)
            assert (samples.successor is not None) == successors
    if wanted:
        seen = metrics["expert"].observation
        np.testing.assert_array_equal(seen, expert.observation[:wanted])
    assert len(calls) == 1
    relabel: Any = ours.relabel
    assert relabel(state.rewarder, params, 5.0) == 5.0


def test_the_inner_methods_own_term_is_added():
    terms = []
    for own in (True, False):
        inner = recorder([])
        inner = inner if own else inner._replace(actor_loss=None)
        ours, state, view, expert = given(inner)
        bias = jax.tree.map(lambda x: x + 0.1, state.params.actor)
        params = state.params._replace(actor=bias)
        key = jax.random.key(0)
        assert ours.actor_loss is not None
        term = compiled(ours.actor_loss)
        terms.append(term(state.rewarder, params, view, expert, key))
    np.testing.assert_allclose(terms[0] - terms[1], 0.7, rtol=1e-4)


def test_another_number_of_expert_samples_is_refused():
    ours, state, view, expert = given(recorder([]))
    short = jax.tree.map(lambda x: x[:-1], expert)
    with pytest.raises(AssertionError):
        ours.update(state.rewarder, state.params, view, short, jax.random.key(0))
