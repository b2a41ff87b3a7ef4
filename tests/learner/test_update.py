"""The update step against a plain rewrite of DrQ-v2, and what it may not move."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.update import Learner, init_train_state, make_update_step
from jaxil.maths.types import Batch, ExpertBatch, Window
from jaxil.native import build
from jaxil.networks.agent import apply, critic_features
from jaxil.rewarders import drqv2, pdac, psil
from tests.tiny_agent import make_episode, make_experts, make_tiny_networks

SIDE, CHANNELS, ACTIONS, BATCH, PADDING = 12, 6, 2, 8, 2
TAU, NOISE_CLIP, LEARNING_RATE = 0.05, 0.3, 3e-3
SPEC = Spec(
    action_dim=ACTIONS,
    feature_dim=5,
    num_demonstrations=2,
    expert_steps=3,
    observation_shape=(SIDE, SIDE, CHANNELS),
)
SCHEDULE = optax.linear_schedule(1.0, 0.0, 10)
NETWORKS = make_tiny_networks(
    action_dim=ACTIONS,
    hidden_dim=8,
    channels=(4, 4),
    kernel_sizes=(3, 3),
    strides=(2, 1),
)


# Made once: a learner is compiled once for all tests that share it.
AGENT = AgentSpec(NETWORKS, SPEC.feature_dim, frame_stack=2, shift_padding=PADDING)
DRQV2 = drqv2.make_rewarder(AGENT)
PDAC = pdac.make_rewarder(
    AGENT,
    hidden_dim=8,
    learning_rate=1e-2,
    gradient_penalty=10.0,
    batch_size=4,
    sees_actions=False,
)
PSIL = psil.make_rewarder(
    AGENT,
    cost="cosine",
    alignment="transport",
    epsilon=0.01,
    num_iterations=20,
    target_update_steps=10,
    return_scale=10.0,
)


def make_learner(rewarder: Rewarder = DRQV2, **changes) -> Learner:
    learner = Learner(
        networks=NETWORKS,
        rewarder=rewarder,
        learning_rate=LEARNING_RATE,
        critic_target_tau=TAU,
        noise_clip=NOISE_CLIP,
        shift_padding=PADDING,
        pre_tanh_penalty=0.0,
        exploration_std=SCHEDULE,
    )
    return dataclasses.replace(learner, **changes)


@functools.cache
def compiled_init(networks, rewarder_init):
    """One program for all learners that start alike, instead of hundreds of small."""
    learner = make_learner(DRQV2._replace(init=rewarder_init), networks=networks)
    observation = np.zeros((SIDE, SIDE, CHANNELS), np.uint8)
    return jax.jit(lambda key: init_train_state(learner, key, observation, SPEC))


def make_state(learner: Learner, seed: int = 0):
    """A state whose target critic is not its critic, or mixing them goes unseen."""
    init = compiled_init(learner.networks, learner.rewarder.init)
    state, other = (init(jax.random.key(n)) for n in (seed, seed + 100))
    return state.replace(target_critic=other.target_critic)


def make_batch(seed: int) -> Batch:
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (2, BATCH, SIDE, SIDE, CHANNELS), dtype=np.uint8)
    return Batch(
        observation=images[0],
        action=rng.uniform(-1, 1, (BATCH, ACTIONS)).astype(np.float32),
        reward=rng.normal(size=BATCH).astype(np.float32),
        discount=rng.choice([0.0, 0.99**3], BATCH).astype(np.float32),
        next_observation=images[1],
    )


def make_expert(seed: int, size: int = 4) -> ExpertBatch:
    batch = make_batch(seed + 1000)
    return ExpertBatch(batch.observation[:size], batch.action[:size])


@functools.cache
def jitted(learner: Learner):
    return jax.jit(make_update_step(learner))


def numbers(leaf) -> np.ndarray:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def assert_identical(first, second):
    jax.tree.map(np.testing.assert_array_equal, *jax.tree.map(numbers, (first, second)))


def any_difference(first, second) -> bool:
    first, second = jax.tree.map(numbers, (first, second))
    leaves = jax.tree.map(lambda a, b: bool(np.any(a != b)), first, second)
    return any(jax.tree.leaves(leaves))


# A rewrite of the whole update -------------------------------------------------


@dataclasses.dataclass
class PlainAgent:
    """Parameters and optimisers as DrQ-v2 keeps them, stepped one by one."""

    encoder: dict
    actor: dict
    critic: dict
    target_critic: dict
    opt_states: dict


def plain_agent(state) -> PlainAgent:
    return PlainAgent(
        encoder=state.encoder.params,
        actor=state.actor.params,
        critic=state.critic.params,
        target_critic=state.target_critic,
        opt_states={
            name: getattr(state, name).opt_state
            for name in ("encoder", "actor", "critic")
        },
    )


def plain_shift(images, key):
    corners = np.asarray(jax.random.randint(key, (BATCH, 2), 0, 2 * PADDING + 1))
    sides = ((0, 0), (PADDING, PADDING), (PADDING, PADDING), (0, 0))
    padded = np.pad(images, sides, mode="edge")
    return np.stack(
        [
            image[row : row + SIDE, column : column + SIDE]
            for image, (row, column) in zip(padded, corners)
        ]
    )


def plain_update(agent: PlainAgent, batch: Batch, key, number: int, mistake: str = ""):
    """One update of DrQ-v2, without the code under test but for its networks.

    Args:
      agent: changed in place.
      batch: sampled.
      key: base key of the run.
      number: of this update.
      mistake: one thing to do wrong, to see that the comparison would notice.

    Returns:
      Losses and targets.
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


def distance(state, agent: PlainAgent) -> float:
    ours = plain_agent(state)
    differences = jax.tree.map(
        lambda a, b: float(np.abs(np.asarray(a) - np.asarray(b)).max()),
        [ours.encoder, ours.actor, ours.critic, ours.target_critic],
        [agent.encoder, agent.actor, agent.critic, agent.target_critic],
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


# Who moves what ----------------------------------------------------------------


def test_only_the_critic_loss_moves_encoder_and_critic():
    # Values of zero at reward zero: the critic loss and its gradient vanish, while
    # actor and discriminator go on learning.
    learner = make_learner(PDAC, pre_tanh_penalty=1.0)
    state = make_state(learner)

    def zero_heads(params):
        layers = dict(params["params"])
        for name in ("value_1", "value_2"):
            output = jax.tree.map(jnp.zeros_like, layers[name]["output"])
            layers[name] = {**layers[name], "output": output}
        return {"params": layers}

    critic = state.critic.replace(params=zero_heads(state.critic.params))
    state = state.replace(critic=critic, target_critic=zero_heads(state.target_critic))
    batch = make_batch(0)._replace(reward=np.zeros(BATCH, np.float32))
    after = state
    for _ in range(3):
        after, metrics = jitted(learner)(after, batch, make_expert(0))
    assert metrics["critic/loss"] == 0.0
    assert_identical(after.encoder.params, state.encoder.params)
    assert_identical(after.critic.params, state.critic.params)
    assert any_difference(after.actor.params, state.actor.params)
    assert any_difference(after.rewarder.params, state.rewarder.params)


def test_the_actor_moves_neither_encoder_nor_critic():
    # Without a bootstrap, the actor has no part in the critic loss: whatever the
    # actor is, encoder and critic must come out the same to the last bit.
    learner = make_learner()
    state = make_state(learner)
    other = make_state(learner, seed=7)
    batch = make_batch(0)._replace(discount=np.zeros(BATCH, np.float32))
    first, _ = jitted(learner)(state, batch, None)
    second, _ = jitted(learner)(state.replace(actor=other.actor), batch, None)
    for name in ("encoder", "critic", "target_critic"):
        assert_identical(getattr(first, name), getattr(second, name))
    assert any_difference(first.actor.params, second.actor.params)
    assert any_difference(first.encoder.params, state.encoder.params)


def test_the_discriminator_moves_nothing_else():
    learner = make_learner(PDAC)
    state, batch = make_state(learner), make_batch(0)
    first, _ = jitted(learner)(state, batch, make_expert(0))
    second, _ = jitted(learner)(state, batch, make_expert(1))
    assert any_difference(first.rewarder.params, second.rewarder.params)
    assert_identical(first.replace(rewarder=()), second.replace(rewarder=()))


def test_relabelled_rewards_replace_the_stored_ones():
    paid = DRQV2._replace(
        relabel=lambda state, learner, batch: batch.window.action[..., 0]
    )
    batch, rng = make_batch(0), np.random.default_rng(0)
    window = Window(
        observation=np.stack([batch.observation] * 3, axis=1),
        action=rng.normal(size=(BATCH, 3, ACTIONS)).astype(np.float32),
        weight=rng.uniform(size=(BATCH, 3)).astype(np.float32),
    )
    reward = np.sum(window.weight * window.action[..., 0], axis=1)
    relabelled, relabelled_metrics = jitted(make_learner(paid))(
        make_state(make_learner(paid)), batch._replace(window=window), None
    )
    stored, stored_metrics = jitted(make_learner())(
        make_state(make_learner()), batch._replace(reward=reward), None
    )
    chex.assert_trees_all_close(relabelled_metrics, stored_metrics, rtol=1e-5)
    chex.assert_trees_all_close(relabelled.params, stored.params, rtol=1e-4, atol=1e-6)
    _, other = jitted(make_learner())(make_state(make_learner()), batch, None)
    assert abs(other["batch/reward"] - relabelled_metrics["batch/reward"]) > 0.1


def test_a_rewarder_with_nothing_to_learn_is_left_alone():
    learner = make_learner(PSIL)
    state = make_state(learner)
    after, _ = jitted(learner)(state, make_batch(0), None)
    assert_identical(after.rewarder, state.rewarder)


def test_the_pre_tanh_penalty_is_a_mean_square():
    # Adam's statistics hold the gradient itself: mu = 0.1 g after one step.
    moments = []
    for weight in (0.0, 2.0):
        learner = make_learner(pre_tanh_penalty=weight)
        state = make_state(learner)
        after, _ = jitted(learner)(state, make_batch(0), None)
        moments.append(after.actor.opt_state[0].mu)
    shift_key = jax.random.split(jax.random.fold_in(state.key, 0), 5)[0]
    shifted = plain_shift(make_batch(0).observation, shift_key)
    z = apply(NETWORKS.encoder, state.encoder.params, shifted)
    gradient = jax.grad(lambda w: jnp.mean(apply(NETWORKS.actor, w, z) ** 2))(
        state.actor.params
    )
    difference = jax.tree.map(lambda a, b: b - a, *moments)
    expected = jax.tree.map(lambda g: 0.1 * 2.0 * g, gradient)
    chex.assert_trees_all_close(difference, expected, atol=1e-5)


# What the rewarder is shown ----------------------------------------------------


def seen_by_rewarder(**changes):
    """Returns what a rewarder that remembers its arguments was given in one update."""

    def update(state, learner, agent, expert, key):
        return {"learner": learner, "agent": agent, "expert": expert}, {"spy": 1.0}

    learner = make_learner(DRQV2._replace(update=update, **changes))
    state = make_state(learner)
    batch = make_batch(0)._replace(successor=make_batch(1).observation)
    expert = make_expert(0)._replace(successor=make_expert(1).observation)
    after, metrics = jax.jit(make_update_step(learner))(state, batch, expert)
    assert metrics["spy"] == 1.0
    return state, batch, expert, after


def test_the_rewarder_sees_augmented_features_from_before_the_update():
    state, batch, _, after = seen_by_rewarder()
    seen, agent = after.rewarder["learner"], after.rewarder["agent"]
    assert_identical(seen, state.params)
    assert any_difference(after.params, state.params)
    shift_key = jax.random.split(jax.random.fold_in(state.key, 0), 5)[0]
    shifted = plain_shift(batch.observation, shift_key)
    np.testing.assert_array_equal(agent.observation, shifted)
    np.testing.assert_array_equal(agent.unshifted, batch.observation)
    np.testing.assert_array_equal(agent.action, batch.action)
    np.testing.assert_allclose(agent.features, features_of(state, shifted), atol=1e-5)
    assert agent.successor is None
    assert agent.successor_features is None


def features_of(state, observation):
    encoder, critic = state.encoder.params, state.critic.params
    return critic_features(NETWORKS, encoder, critic, jnp.asarray(observation))


def test_successors_come_augmented_with_their_features_and_change_nothing_else():
    _, _, _, without = seen_by_rewarder()
    state, batch, expert, after = seen_by_rewarder(samples_successors=True)
    agent = after.rewarder["agent"]
    assert batch.successor is not None
    padded = np.pad(
        batch.successor,
        ((0, 0), (PADDING, PADDING), (PADDING, PADDING), (0, 0)),
        mode="edge",
    )
    crops = np.lib.stride_tricks.sliding_window_view(padded, (SIDE, SIDE), (1, 2))
    crops = np.moveaxis(crops, 3, -1)  # [B, 5, 5, SIDE, SIDE, C]
    matches = np.all(
        crops == np.asarray(agent.successor)[:, None, None], axis=(3, 4, 5)
    )
    assert np.all(matches.sum(axis=(1, 2)) == 1)  # each is one of the 25 shifts
    assert len({tuple(np.argwhere(m)[0]) for m in matches}) > 1
    features = features_of(state, agent.successor)
    np.testing.assert_allclose(agent.successor_features, features, atol=1e-5)
    np.testing.assert_array_equal(after.rewarder["expert"].successor, expert.successor)
    # The learner, and what the rewarder saw before, are the same to the last bit.
    assert_identical(after.replace(rewarder=()), without.replace(rewarder=()))
    assert_identical(
        agent._replace(successor=None, successor_features=None),
        without.rewarder["agent"],
    )


# A method's own term in the actor's loss ---------------------------------------


def with_actor_loss(actor_loss, **changes) -> Learner:
    return make_learner(DRQV2._replace(actor_loss=actor_loss), **changes)


def test_a_term_in_the_actors_loss_pulls_the_policy_and_nothing_else():
    target = np.array([0.8, -0.8], np.float32)

    def mean_action(learner, observation):
        z = jax.lax.stop_gradient(apply(NETWORKS.encoder, learner.encoder, observation))
        return jnp.tanh(apply(NETWORKS.actor, learner.actor, z))

    def pull(state, learner, agent, expert, key):
        error = mean_action(learner, expert.observation) - target[None]
        return 100.0 * jnp.mean(error**2)

    learner, expert = with_actor_loss(pull, learning_rate=1e-2), make_expert(0)
    state = start = make_state(learner)
    for _ in range(150):
        state, metrics = jitted(learner)(state, make_batch(0), expert)
        assert np.isfinite(metrics["actor/loss"])
    before, after = (
        np.abs(np.asarray(mean_action(s.params, expert.observation)) - target).max()
        for s in (start, state)
    )
    assert after < 0.25 < before
    # One update with and without it: only the actor differs.
    pulled, plain = (
        jitted(each)(start, make_batch(0), expert)[0]
        for each in (learner, with_actor_loss(None, learning_rate=1e-2))
    )
    assert any_difference(pulled.actor, plain.actor)
    assert_identical(pulled.replace(actor=()), plain.replace(actor=()))


# Keys, schedules, compilation --------------------------------------------------


def test_draws_depend_on_the_number_of_the_update_alone():
    # Without a bootstrap the noise plays no part: what differs is the shift.
    learner = make_learner()
    state = make_state(learner)
    batch = make_batch(0)._replace(discount=np.zeros(BATCH, np.float32))
    first, _ = jitted(learner)(state, batch, None)
    again, _ = jitted(learner)(state, batch, None)
    assert_identical(first, again)
    later = state.replace(num_updates=jnp.asarray(5, jnp.int32))
    other, _ = jitted(learner)(later, batch, None)
    assert any_difference(first.encoder.params, other.encoder.params)
    assert (first.num_updates, other.num_updates) == (1, 6)
    assert_identical(first.key, state.key)


@pytest.mark.parametrize(("num_updates", "std"), [(0, 1.0), (4, 0.6), (50, 0.0)])
def test_noise_follows_the_number_of_the_update(num_updates, std):
    learner = make_learner()
    state = make_state(learner).replace(num_updates=jnp.asarray(num_updates, jnp.int32))
    _, metrics = jitted(learner)(state, make_batch(0), None)
    np.testing.assert_allclose(metrics["exploration_std"], std, atol=1e-6)


@pytest.mark.parametrize(
    ("rewarder", "expert"),
    [(PDAC, make_expert), (PSIL, None)],
    ids=["pdac", "psil"],
)
def test_compiles_once_and_donates_its_state(rewarder, expert):
    learner = make_learner(rewarder)
    chex.clear_trace_counter()
    counted = chex.assert_max_traces(make_update_step(learner), n=1)
    step = jax.jit(counted, donate_argnums=0)
    observe = jax.jit(learner.rewarder.observe)
    state = make_state(learner)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (3, 4, SIDE, SIDE, CHANNELS // 2), dtype=np.uint8)
    episode, experts = make_episode(frames[0]), make_experts(frames[1:])
    for seed in range(3):
        old = state
        state, _ = step(
            state, make_batch(seed), None if expert is None else expert(seed)
        )
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(old.params))
        # An episode in between must not change the state's types.
        observed = observe(state.rewarder, state.params, episode, experts)
        state = state.replace(rewarder=observed)
    chex.assert_tree_all_finite(state.params)


def test_rejects_a_column_of_rewards():
    learner = make_learner()
    batch = make_batch(0)._replace(reward=np.zeros((BATCH, 1), np.float32))
    with pytest.raises(AssertionError):
        make_update_step(learner)(make_state(learner), batch, None)


def test_native_convolutions_learn_the_same_over_50_updates():
    # Sums are taken in another order, so rounding differs, and Adam magnifies what
    # differs in small gradients; 50 updates of 3e-3 keep it below 1e-4.
    assert build.problem() is None
    encoder = NETWORKS.encoder.clone(channels=(32, 32))
    networks = [
        NETWORKS._replace(encoder=encoder.clone(native=own)) for own in (False, True)
    ]
    learners = [make_learner(networks=each) for each in networks]
    states = [make_state(learner) for learner in learners]
    program = jax.make_jaxpr(make_update_step(learners[1]))
    uses_ours = "jaxil_encode" in str(program(states[1], make_batch(0), None))
    assert uses_ours
    for number in range(50):
        batch = make_batch(number)
        states = [
            jitted(learner)(state, batch, None)[0]
            for learner, state in zip(learners, states)
        ]
    chex.assert_trees_all_close(
        states[0].params, states[1].params, rtol=1e-3, atol=1e-4
    )
    # Not for want of learning: what was learned is far larger than the tolerance.
    start = make_state(learners[0]).params
    moved = jax.tree.map(
        lambda a, b: float(jnp.max(jnp.abs(a - b))),
        start.encoder,
        states[0].params.encoder,
    )
    assert min(jax.tree.leaves(moved)) > 2e-2
