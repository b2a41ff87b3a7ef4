"""P-SIL: which demonstration, which networks, which scale, and when."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxil.maths import stacking, transport
from jaxil.networks.agent import actor_features
from jaxil.rewarders import psil
from jaxil.rewarders.matching import closest, make_matching
from tests.tiny_agent import (
    NETWORKS,
    SIDE,
    make_agent,
    make_episode,
    make_experts,
    make_params,
    make_play,
    make_spec,
    random_frames,
)

STEPS, EXPERT_STEPS, K = 6, 5, 3
SPEC = make_spec(num_demonstrations=K, expert_steps=EXPERT_STEPS)
EXPERTS = make_experts(random_frames(50, K, EXPERT_STEPS + 1))


@functools.cache
def make_rewarder(frame_stack=1, alignment="transport"):
    return psil.make_rewarder(
        make_agent(frame_stack),
        cost="cosine",
        alignment=alignment,
        epsilon=0.01,
        num_iterations=50,
        target_update_steps=20,
        num_components=0,
        return_scale=10.0,
    )


@functools.cache
def compiled(frame_stack):
    return make_play(make_rewarder(frame_stack))


def start(params, spec=SPEC):
    return make_rewarder().init(jax.random.key(0), spec, params)


def play(state, params, frames, experts=EXPERTS, frame_stack=1):
    """Ends an episode; returns its rewards and the state after it."""
    episode = make_episode(frames)
    rewards, state = compiled(frame_stack)(state, params, episode, experts)
    return np.asarray(rewards), state


def first_rewards(params, frames, experts=EXPERTS, frame_stack=1, spec=SPEC):
    """Rewards of an episode that is a run's first."""
    return play(start(params, spec), params, frames, experts, frame_stack)[0]


@functools.partial(jax.jit, static_argnames=("epsilon", "num_iterations"))
def solve(costs, *, epsilon, num_iterations):
    """Rewards to demonstrations of one length."""
    masses = [jnp.full(size, 1.0 / size) for size in costs.shape[1:]]
    matching = make_matching(
        cost="cosine",
        alignment="transport",
        epsilon=epsilon,
        num_iterations=num_iterations,
    )
    plans = jax.vmap(lambda c: matching.plan(c, *masses))(costs)
    return closest(costs, plans)[0]


# The transport -----------------------------------------------------------------


def test_rewards_are_those_of_the_best_assignment():
    # Few points, little entropy and many iterations: the plan is a permutation, if
    # the second best costs clearly more.
    solved = 0
    for seed in range(20):
        cost = np.random.default_rng(seed).uniform(0, 2, (4, 4)).astype(np.float32)
        totals = sorted(
            cost[np.arange(4), order].sum()
            for order in itertools.permutations(range(4))
        )
        if totals[1] - totals[0] > 0.2:
            rows, columns = scipy.optimize.linear_sum_assignment(cost)
            rewards = solve(jnp.asarray(cost[None]), epsilon=0.005, num_iterations=3000)
            np.testing.assert_allclose(rewards, -cost[rows, columns] / 4, atol=1e-3)
            solved += 1
    assert solved >= 5


def test_demonstrations_are_compared_by_cost_and_not_by_entropy():
    # At a large epsilon the entropy would decide: a plan on few columns is poor in
    # entropy whatever it costs. Costs alone: 0.4 against 0.5.
    sharp = 0.4 + 4.0 * (1.0 - np.eye(4, dtype=np.float32))
    flat = np.full((4, 4), 0.5, np.float32)
    rewards = solve(
        jnp.asarray(np.stack([sharp, flat])), epsilon=0.5, num_iterations=200
    )
    np.testing.assert_allclose(rewards.sum(), -0.4, atol=0.02)


def test_a_demonstration_played_back_is_found():
    params = make_params(0)
    _, state = play(start(params), params, random_frames(1, STEPS + 1))
    for frames in EXPERTS.frames:
        rewards, _ = play(state, params, np.asarray(frames))
        np.testing.assert_allclose(rewards, 0.0, atol=1e-2 * state.scale)


# Which observation, which networks ---------------------------------------------


@pytest.mark.parametrize("special", range(STEPS + 1))
def test_reward_t_is_of_observation_t_plus_1(special):
    # All frames are those of the expert but one, which alone has to be carried far.
    plain = random_frames(1, 1)[0]
    experts = make_experts(np.broadcast_to(plain, (K, EXPERT_STEPS + 1, *plain.shape)))
    # A first episode sets the scale, so that this one's is not taken up with it.
    params = make_params(0)
    _, state = play(start(params), params, random_frames(1, STEPS + 1), experts)
    frames = np.repeat(plain[None], STEPS + 1, axis=0)
    frames[special] = random_frames(2, 1)[0]
    rewards, _ = play(state, params, frames, experts)
    below = np.flatnonzero(rewards < -1e-3)
    expected = [] if special == 0 else [special - 1]  # nothing led to o_0
    np.testing.assert_array_equal(below, expected)


@pytest.mark.parametrize("frame_stack", [1, 2])
def test_rewards_step_by_step(frame_stack):
    params, frames = make_params(0, frame_stack), random_frames(1, STEPS + 1)

    def features(frames):
        stacks = stacking.stack_frames(frames, frame_stack=frame_stack)
        return actor_features(NETWORKS, params.encoder, params.actor, stacks)

    candidates = []
    for demonstration in EXPERTS.frames:
        cost = transport.cosine_cost(
            features(jnp.asarray(frames)), features(jnp.asarray(demonstration))
        )
        masses = (jnp.full(n + 1, 1.0 / (n + 1)) for n in (STEPS, EXPERT_STEPS))
        plan = transport.sinkhorn_plan(cost, *masses, epsilon=0.01, num_iterations=50)
        candidates.append(-np.sum(np.asarray(cost) * np.asarray(plan), axis=1))
    best = max(candidates, key=np.sum)[1:]
    rewards = first_rewards(params, frames, EXPERTS, frame_stack)
    assert len(rewards) == STEPS
    np.testing.assert_allclose(rewards, best * 10.0 / -np.sum(best), rtol=1e-3)


def test_the_padding_of_a_short_demonstration_counts_for_nothing():
    # The same demonstrations, once alone and once padded to twice their length with
    # frames that would be far cheaper to reach: the agent's own.
    params, frames = make_params(0), random_frames(1, STEPS + 1)
    padded = np.concatenate([EXPERTS.frames, EXPERTS.frames], axis=1)
    padded[:, EXPERT_STEPS + 1 :] = frames[0]
    spec = SPEC._replace(expert_steps=padded.shape[1] - 1)
    longer = make_experts(padded)
    short = longer._replace(num_frames=EXPERTS.num_frames)
    rewards = first_rewards(params, frames, short, spec=spec)
    np.testing.assert_allclose(rewards, first_rewards(params, frames), rtol=1e-4)
    other = first_rewards(params, frames, longer, spec=spec)
    assert np.abs(other - rewards).max() > 1e-2


def test_reads_the_actors_trunk_and_nothing_of_the_critic():
    frames, params, other = random_frames(1, STEPS + 1), make_params(0), make_params(1)
    rewards = first_rewards(params, frames)
    np.testing.assert_array_equal(
        first_rewards(params._replace(critic=other.critic), frames), rewards
    )
    trunk, head = ({**params.actor["params"]} for _ in range(2))
    head["head"] = other.actor["params"]["head"]
    np.testing.assert_array_equal(
        first_rewards(params._replace(actor={"params": head}), frames), rewards
    )
    trunk["trunk"] = other.actor["params"]["trunk"]
    changed = first_rewards(params._replace(actor={"params": trunk}), frames)
    assert np.abs(changed - rewards).max() > 1e-3
    changed = first_rewards(params._replace(encoder=other.encoder), frames)
    assert np.abs(changed - rewards).max() > 1e-3


# Scale and target copies -------------------------------------------------------


def test_the_first_episode_sets_the_scale_for_good():
    summary, params = make_rewarder().summary, make_params(0)
    state, first = start(params), random_frames(1, STEPS + 1)
    assert summary(state) == {"sinkhorn/scale": 0.0}
    rewards, state = play(state, params, first)
    np.testing.assert_allclose(np.sum(rewards), -10.0, rtol=1e-5)
    scale = state.scale
    assert scale > 0.0
    # An easier episode: half of it is a demonstration.
    frames = random_frames(2, STEPS + 1)
    frames[:4] = EXPERTS.frames[0][:4]
    rewards, state = play(state, params, frames)
    assert state.scale == scale
    assert -8.0 < np.sum(rewards) < 0.0
    # The first episode over again returns what it did.
    rewards, state = play(state, params, first)
    np.testing.assert_allclose(np.sum(rewards), -10.0, rtol=1e-5)
    # A copy of other networks leaves it as it is, too.
    due = state.replace(steps_since_copy=jnp.asarray(99))
    _, copied = play(due, make_params(1), first)
    assert summary(copied)["sinkhorn/scale"] == scale


def test_a_perfect_first_episode_leaves_the_scale_finite():
    black = np.zeros((STEPS + 1, SIDE, SIDE, 3), np.uint8)
    experts = EXPERTS._replace(frames=np.zeros_like(EXPERTS.frames))
    params = make_params(0)
    rewards, state = play(start(params), params, black, experts)
    assert np.all(np.isfinite(rewards))
    assert np.isfinite(state.scale)


@pytest.mark.parametrize(
    ("lengths", "copies"),
    [
        # 20 steps are due: three episodes of 7 after each copy. 7 divides nothing,
        # so a modulo of the step count would hardly ever be zero.
        ([7, 7, 7, 7, 7, 7, 7], [True, False, False, True, False, False, True]),
        # Exactly due, then overdue at once, then one step short.
        ([10, 10, 10, 25, 19, 1], [True, False, True, True, False, True]),
    ],
)
def test_targets_are_copied_when_due(lengths, copies):
    # Which moments are paired plays no part: time compiles sooner than transport.
    rewarder, base = make_rewarder(alignment="time"), make_params(0)
    assert rewarder.rewards_changed is not None
    observe = jax.jit(rewarder.observe)
    state, held = start(base), None
    jax.tree.map(np.testing.assert_array_equal, state.target_actor, base.actor)
    for number, (length, copied) in enumerate(zip(lengths, copies, strict=True)):
        # Live networks change with every episode.
        live = jax.tree.map(lambda leaf, n=number: leaf * (1.0 + 0.1 * n), base)
        episode = make_episode(random_frames(number, length + 1))
        state = observe(state, live, episode, EXPERTS)
        assert bool(rewarder.rewards_changed(state)) is copied
        held = live if copied else held
        assert held is not None
        jax.tree.map(np.testing.assert_array_equal, state.target_encoder, held.encoder)
        jax.tree.map(np.testing.assert_array_equal, state.target_actor, held.actor)
        features = actor_features(
            NETWORKS, held.encoder, held.actor, jnp.asarray(EXPERTS.frames[1])
        )
        np.testing.assert_allclose(state.expert_features[1], features, atol=1e-5)


def test_rewards_do_not_follow_the_live_networks_between_copies():
    params, frames = make_params(0), random_frames(1, STEPS + 1)
    first, state = play(start(params), params, frames)
    second, _ = play(state, make_params(1), frames)
    np.testing.assert_array_equal(first, second)
