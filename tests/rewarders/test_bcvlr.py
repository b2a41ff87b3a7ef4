"""BCV-LR: latent actions of the video, which the agent's own play decodes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.learner.policy import make_mean_action
from jaxil.maths.types import ExpertBatch
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import Embedding
from jaxil.rewarders import bcvlr
from tests.rewarders.small_world import (
    demonstrations,
    expert_actions,
    learner_of,
    pictures,
    play,
    record_shifts,
    state_of,
)
from tests.tiny_agent import make_episode, random_frames

SETTINGS = {
    "batch_size": 32,
    "std": 0.1,
    "num_parts": 4,
    "num_codes": 16,
    "part_dim": 4,
    "hidden_dim": 32,
    "learning_rate": 3e-3,
    "commitment": 0.05,
    "prediction_weight": 1.0,
    "target_tau": 0.05,
}


@functools.cache
def make_learner(observation="state", shift_padding=0, **changes):
    settings = SETTINGS | changes
    return learner_of(bcvlr.make_rewarder, observation, shift_padding, settings)


@functools.cache
def make_step(observation="state", shift_padding=0, **changes):
    learner = make_learner(observation, shift_padding, **changes)
    return jax.jit(bcvlr.make_update_step(learner, **(SETTINGS | changes)))


@functools.cache
def make_state(observation="state", shift_padding=0, **changes):
    return state_of(make_learner(observation, shift_padding, **changes), observation)


@functools.cache
def trained(num_updates, video=demonstrations, **changes):
    """Returns the state after so many updates, and the metrics of each."""
    step, state = make_step(**changes), make_state(**changes)
    rng, metrics = np.random.default_rng(0), []
    for _ in range(num_updates):
        state, measured = step(state, play(rng), video(rng))
        metrics.append(measured)
    return state, jax.device_get(metrics)


def last(metrics, name):
    """Returns the mean over the last twenty updates."""
    return np.mean([row[name] for row in metrics[-20:]])


def test_the_policy_copies_actions_that_nobody_told_it():
    (state, metrics), before = trained(600), make_state()
    assert last(metrics, "latent/error") < 0.05  # of a mean square of 0.67
    seen = demonstrations(np.random.default_rng(1)).observation
    copied = make_mean_action(make_learner().networks)(
        state.encoder.params, state.actor.params, seen
    )
    error = np.mean(np.square(copied - expert_actions(seen)))
    assert error < 0.1 * np.mean(np.square(expert_actions(seen)))
    assert int(state.num_updates) == 600
    for name in ("critic", "target_critic"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(state, name), getattr(before, name)
        )


def test_what_comes_next_is_predicted_from_the_codes():
    """Where actions are chance, one code for all predicts far worse than sixteen."""

    def video(rng):
        batch = play(rng)
        return ExpertBatch(batch.observation, batch.action * np.nan, batch.successor)

    _, metrics = trained(200, video)
    assert metrics[0]["latent/prediction"] > 1.0  # what a constant guess costs
    assert last(metrics, "latent/prediction") < 0.3
    assert last(metrics, "latent/codes_used") > 2.0
    assert all(np.isfinite(list(row.values())).all() for row in metrics)
    _, without = trained(200, video, num_codes=1)
    assert last(without, "latent/codes_used") == 1.0
    assert last(without, "latent/prediction") > 0.5


def test_features_that_are_predicted_do_not_shrink_to_a_constant():
    """Not even where play has hardly any weight."""
    embedding = Embedding(make_learner().networks.encoder, 16)
    seen = demonstrations(np.random.default_rng(1), size=256).observation

    def spread(state):
        features = apply(embedding, state.rewarder.target, seen)
        return float(np.mean(np.std(features, axis=0)))

    # With plain squared errors, 0.65 of the spread is left here.
    alone, _ = trained(300, prediction_weight=1e5)
    assert spread(alone) > 0.75 * spread(make_state())


def test_nothing_reads_the_actions_of_the_expert():
    """Demonstrations here have NaN for actions; with zeros every number is the same."""
    rng = np.random.default_rng(0)
    batch, expert = play(rng), demonstrations(rng)
    told = expert._replace(action=np.zeros_like(expert.action))
    one, one_metrics = make_step()(make_state(), batch, expert)
    other, other_metrics = make_step()(make_state(), batch, told)
    one, other = (s.replace(key=jax.random.key_data(s.key)) for s in (one, other))
    jax.tree.map(np.testing.assert_array_equal, one, other)
    jax.tree.map(np.testing.assert_array_equal, one_metrics, other_metrics)
    assert np.isfinite(list(one_metrics.values())).all()


def test_the_decoder_learns_from_the_agent_and_the_codes_from_the_video():
    def after(batch_seed, expert_seed):
        state, _ = make_step()(
            make_state(),
            play(np.random.default_rng(batch_seed)),
            demonstrations(np.random.default_rng(expert_seed)),
        )
        return state.rewarder.live.params[1]["params"]

    first, other_video, other_play = after(0, 1), after(0, 2), after(3, 1)
    different = functools.partial(
        jax.tree.map, lambda x, y: bool(np.any(np.asarray(x) != np.asarray(y)))
    )
    for name in ("decoder", "codebook", "forward", "inverse"):
        from_video = jax.tree.leaves(different(first[name], other_video[name]))
        from_play = jax.tree.leaves(different(first[name], other_play[name]))
        assert any(from_video) == (name != "decoder")
        assert any(from_play) == (name in ("decoder", "inverse"))


def test_the_target_follows_slowly():
    rng = np.random.default_rng(0)
    state, _ = make_step()(make_state(), play(rng), demonstrations(rng))
    old, new, live = (
        jax.tree.leaves(params)
        for params in (
            make_state().rewarder.target,
            state.rewarder.target,
            state.rewarder.live.params[0],
        )
    )
    for before, after, followed in zip(old, new, live, strict=True):
        expected = 0.95 * before + 0.05 * followed
        np.testing.assert_allclose(after, expected, rtol=1e-5, atol=1e-7)
        assert np.any(followed != before)


def test_both_observations_of_a_pair_are_shifted_alike(monkeypatch):
    """If nothing moves, the inverse model must see that nothing moves."""
    seen = record_shifts(monkeypatch)
    batch, expert = pictures()
    step = bcvlr.make_update_step(make_learner("pixels", 2), **SETTINGS)
    step(make_state("pixels", 2), batch, expert)
    pairs = [x for x in seen if x.shape[-1] == 6]
    assert len(pairs) == 2  # play and video
    for pair in pairs:
        np.testing.assert_array_equal(pair[..., :3], pair[..., 3:])
        assert np.any(pair[..., :3] != batch.observation)
    assert np.any(pairs[0] != pairs[1])


def test_learns_from_pixels():
    state, step = make_state("pixels", 2), make_step("pixels", 2)
    before = state
    for seed in range(3):
        state, metrics = step(state, *pictures(seed))
        assert np.isfinite(list(metrics.values())).all()
    for name in ("encoder", "actor"):
        changed = jax.tree.map(
            lambda x, y: bool(np.any(x != y)),
            getattr(state, name).params,
            getattr(before, name).params,
        )
        assert any(jax.tree.leaves(changed))


def test_asks_for_successors_and_refuses_another_number_of_samples():
    rewarder = make_learner().rewarder
    assert rewarder.expert_batch_size == 32
    assert rewarder.samples_successors
    rng = np.random.default_rng(0)
    with pytest.raises(AssertionError):
        make_step()(make_state(), play(rng), demonstrations(rng, size=31))
    with pytest.raises(AssertionError):
        make_step()(make_state(), play(rng)._replace(successor=None), None)


def test_rewards_nothing():
    episode = make_episode(random_frames(0, 6))
    params = make_state().params
    rewards = make_learner().rewarder.rewards((), params, episode, None)
    np.testing.assert_array_equal(rewards, jnp.zeros(5))
