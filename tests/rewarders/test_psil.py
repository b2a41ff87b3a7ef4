"""P-SIL: which demonstration, which networks, which scale, and when."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxil.maths import stacking, transport
from jaxil.maths.types import ExpertEpisodes
from jaxil.networks.agent import actor_features
from jaxil.rewarders.matching import closest_rewards, make_matching
from jaxil.rewarders.psil import make_sinkhorn_rewarder
from tests.tiny_agent import (
    NETWORKS,
    SIDE,
    make_episode,
    make_params,
    make_spec,
    random_frames,
)

STEPS, EXPERT_STEPS, K = 6, 5, 3
SPEC = make_spec(num_demonstrations=K, expert_steps=EXPERT_STEPS)


@functools.cache
def make_rewarder(frame_stack=1, target_update_steps=20):
    rewarder = make_sinkhorn_rewarder(
        NETWORKS,
        matching=make_matching(
            cost="cosine", alignment="transport", epsilon=0.01, num_iterations=50
        ),
        target_update_steps=target_update_steps,
        return_scale=10.0,
        frame_stack=frame_stack,
    )
    return rewarder._replace(rewards=jax.jit(rewarder.rewards))


def make_experts(seed=50):
    return ExpertEpisodes(
        random_frames(seed, K, EXPERT_STEPS + 1),
        np.full(K, EXPERT_STEPS + 1),
        np.zeros((K, EXPERT_STEPS, 2)),
    )


@functools.partial(jax.jit, static_argnames=("epsilon", "num_iterations"))
def solve(costs, *, epsilon, num_iterations):
    """Rewards to demonstrations of one length."""
    masses = jnp.full((costs.shape[0], costs.shape[2]), 1.0 / costs.shape[2])
    matching = make_matching(
        cost="cosine",
        alignment="transport",
        epsilon=epsilon,
        num_iterations=num_iterations,
    )
    return closest_rewards(costs, jax.vmap(matching.plan)(costs, masses))


def start(rewarder, params):
    return rewarder.init(jax.random.key(0), SPEC, params)


def first_rewards(params, frames, experts=None, frame_stack=1):
    """Rewards of an episode that is a run's first."""
    rewarder = make_rewarder(frame_stack)
    rewards, _ = rewarder.rewards(
        start(rewarder, params), params, make_episode(frames), experts or make_experts()
    )
    return np.asarray(rewards)


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


def test_the_cheapest_demonstration_is_chosen():
    levels = np.array([1.5, 0.5, 1.0], np.float32)[:, None, None]
    costs = np.broadcast_to(levels, (3, 4, 2))
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        rewards = solve(jnp.asarray(costs[order]), epsilon=0.01, num_iterations=20)
        np.testing.assert_allclose(rewards, np.full(4, -0.5 / 4), rtol=1e-5)


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
    experts = make_experts()
    params = make_params(0)
    rewarder = make_rewarder()
    _, state = rewarder.rewards(
        start(rewarder, params),
        params,
        make_episode(random_frames(1, STEPS + 1)),
        experts,
    )
    for k in range(K):
        frames = np.asarray(experts.frames[k])
        rewards, _ = rewarder.rewards(state, params, make_episode(frames), experts)
        np.testing.assert_allclose(rewards, 0.0, atol=1e-2 * state.scale)


# Which observation, which networks ---------------------------------------------


@pytest.mark.parametrize("special", range(STEPS + 1))
def test_reward_t_is_of_observation_t_plus_1(special):
    # All frames are those of the expert but one, which alone has to be carried far.
    plain = random_frames(1, 1)[0]
    experts = ExpertEpisodes(
        np.broadcast_to(plain, (K, EXPERT_STEPS + 1, *plain.shape)),
        np.full(K, EXPERT_STEPS + 1),
        np.zeros((K, EXPERT_STEPS, 2)),
    )
    # A first episode sets the scale, so that this one's is not taken up with it.
    rewarder, params = make_rewarder(), make_params(0)
    first = make_episode(random_frames(1, STEPS + 1))
    _, state = rewarder.rewards(start(rewarder, params), params, first, experts)
    frames = np.repeat(plain[None], STEPS + 1, axis=0)
    frames[special] = random_frames(2, 1)[0]
    rewards, _ = rewarder.rewards(state, params, make_episode(frames), experts)
    below = np.flatnonzero(np.asarray(rewards) < -1e-3)
    expected = [] if special == 0 else [special - 1]  # nothing led to o_0
    np.testing.assert_array_equal(below, expected)


@pytest.mark.parametrize("frame_stack", [1, 2])
def test_rewards_step_by_step(frame_stack):
    params, experts = make_params(0, frame_stack), make_experts()
    frames = random_frames(1, STEPS + 1)

    def features(frames):
        stacks = stacking.stack_frames(frames, frame_stack=frame_stack)
        return actor_features(NETWORKS, params.encoder, params.actor, stacks)

    candidates = []
    for demonstration in experts.frames:
        cost = transport.cosine_cost(
            features(jnp.asarray(frames)), features(jnp.asarray(demonstration))
        )
        mass = jnp.full(EXPERT_STEPS + 1, 1.0 / (EXPERT_STEPS + 1))
        plan = transport.sinkhorn_plan(cost, mass, epsilon=0.01, num_iterations=50)
        candidates.append(-np.sum(np.asarray(cost) * np.asarray(plan), axis=1))
    best = max(candidates, key=np.sum)[1:]
    rewards = first_rewards(params, frames, experts, frame_stack)
    assert len(rewards) == STEPS
    np.testing.assert_allclose(rewards, best * 10.0 / -np.sum(best), rtol=1e-3)


def test_what_fills_a_short_demonstration_up_counts_for_nothing():
    # The same demonstrations, once alone and once filled up to twice their length with
    # frames that would be far cheaper to reach: the agent's own.
    params, experts = make_params(0), make_experts()
    frames = random_frames(1, STEPS + 1)
    filled = np.concatenate([experts.frames, experts.frames], axis=1)
    filled[:, EXPERT_STEPS + 1 :] = frames[0]
    longer = experts._replace(frames=filled)
    spec = SPEC._replace(expert_steps=filled.shape[1] - 1)
    rewarder = make_rewarder()
    rewards, _ = rewarder.rewards(
        rewarder.init(jax.random.key(0), spec, params),
        params,
        make_episode(frames),
        longer,
    )
    np.testing.assert_allclose(
        rewards, first_rewards(params, frames, experts), rtol=1e-4
    )
    with_filling = longer._replace(num_frames=np.full(K, filled.shape[1]))
    other, _ = rewarder.rewards(
        rewarder.init(jax.random.key(0), spec, params),
        params,
        make_episode(frames),
        with_filling,
    )
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
    rewarder, params, experts = make_rewarder(), make_params(0), make_experts()
    state = start(rewarder, params)
    assert rewarder.summary(state) == {"sinkhorn/scale": 0.0}
    first = make_episode(random_frames(1, STEPS + 1))
    rewards, state = rewarder.rewards(state, params, first, experts)
    np.testing.assert_allclose(np.sum(rewards), -10.0, rtol=1e-5)
    scale = state.scale
    assert scale > 0.0
    # An easier episode: half of it is a demonstration.
    frames = random_frames(2, STEPS + 1)
    frames[:4] = experts.frames[0][:4]
    rewards, state = rewarder.rewards(state, params, make_episode(frames), experts)
    assert state.scale == scale
    assert -8.0 < np.sum(rewards) < 0.0
    # The first episode over again returns what it did.
    rewards, state = rewarder.rewards(state, params, first, experts)
    np.testing.assert_allclose(np.sum(rewards), -10.0, rtol=1e-5)
    # A copy of other networks leaves it as it is, too.
    rewarder.rewards(
        state.replace(steps_since_copy=jnp.asarray(99)), make_params(1), first, experts
    )
    assert rewarder.summary(state)["sinkhorn/scale"] == scale


def test_a_perfect_first_episode_leaves_the_scale_finite():
    rewarder, params, experts = make_rewarder(), make_params(0), make_experts()
    black = np.zeros((STEPS + 1, SIDE, SIDE, 3), np.uint8)
    experts = experts._replace(frames=np.zeros_like(experts.frames))
    rewards, state = rewarder.rewards(
        start(rewarder, params), params, make_episode(black), experts
    )
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
    rewarder = make_rewarder()
    experts = make_experts()
    base = make_params(0)
    state = start(rewarder, base)
    jax.tree.map(np.testing.assert_array_equal, state.target_actor, base.actor)
    held = None
    for number, (length, copied) in enumerate(zip(lengths, copies, strict=True)):
        # Live networks change with every episode.
        live = jax.tree.map(lambda leaf, n=number: leaf * (1.0 + 0.1 * n), base)
        episode = make_episode(random_frames(number, length + 1))
        _, state = rewarder.rewards(state, live, episode, experts)
        held = live if copied else held
        assert held is not None
        jax.tree.map(np.testing.assert_array_equal, state.target_encoder, held.encoder)
        jax.tree.map(np.testing.assert_array_equal, state.target_actor, held.actor)
        features = actor_features(
            NETWORKS, held.encoder, held.actor, jnp.asarray(experts.frames[1])
        )
        np.testing.assert_allclose(state.expert_features[1], features, atol=1e-5)


def test_rewards_do_not_follow_the_live_networks_between_copies():
    rewarder, params, experts = make_rewarder(), make_params(0), make_experts()
    episode = make_episode(random_frames(1, STEPS + 1))
    first, state = rewarder.rewards(start(rewarder, params), params, episode, experts)
    second, _ = rewarder.rewards(state, make_params(1), episode, experts)
    np.testing.assert_array_equal(first, second)
