"""The learner's state: what it starts as, and one optimiser step by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxil.learner.rewarder import Spec
from jaxil.learner.state import (
    LearnerParams,
    apply_gradients,
    copy_params,
    init_module,
)
from jaxil.learner.update import Learner, init_train_state, make_update_step
from jaxil.maths.types import Batch
from jaxil.rewarders import drqv2
from tests.tiny_agent import make_agent, make_tiny_networks

SPEC = Spec(2, num_demonstrations=0, expert_steps=0, observation_shape=(12, 12, 6))


def tiny_learner():
    networks = make_tiny_networks(observation="state")
    return Learner(
        networks=networks,
        rewarder=drqv2.make_rewarder(make_agent()),
        learning_rate=1e-3,
        critic_target_tau=0.01,
        noise_clip=0.3,
        shift_padding=1,
        pre_tanh_penalty=0.0,
        exploration_std=optax.constant_schedule(0.2),
    )


def tiny_state(seed=0):
    return init_train_state(
        tiny_learner(), jax.random.key(seed), jnp.zeros(7, jnp.float32), SPEC
    )


def pointers(tree):
    return {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(tree)}


def test_the_first_adam_step_is_the_sign_of_the_gradient():
    # m / (1 - b1) = g and v / (1 - b2) = g^2, so the step is g / (|g| + 1e-8).
    optimiser = optax.adam(0.1)
    module = init_module({"w": jnp.array([1.0, 2.0, 3.0])}, optimiser)
    gradients = {"w": jnp.array([0.5, -4.0, 0.0])}
    stepped = apply_gradients(module, gradients, optimiser)
    np.testing.assert_allclose(stepped.params["w"], [0.9, 2.1, 3.0], rtol=1e-6)
    np.testing.assert_array_equal(module.params["w"], [1.0, 2.0, 3.0])


def test_optimiser_statistics_are_kept():
    # Equal gradients twice: the bias-corrected moments are g and g^2 again.
    optimiser = optax.adam(0.1)
    module = init_module(jnp.array(1.0), optimiser)
    for expected in (0.9, 0.8):
        module = apply_gradients(module, jnp.array(3.0), optimiser)
        np.testing.assert_allclose(module.params, expected, rtol=1e-5)


def test_copies_have_their_own_buffers():
    params = {"a": jnp.arange(3.0), "b": {"c": jnp.ones((2, 2))}}
    copies = copy_params(params)
    jax.tree.map(np.testing.assert_array_equal, params, copies)
    assert not pointers(params) & pointers(copies)


def test_params_are_the_live_ones():
    state = tiny_state()
    assert isinstance(state.params, LearnerParams)
    assert state.params.encoder is state.encoder.params
    assert state.params.actor is state.actor.params
    assert state.params.critic is state.critic.params


def test_targets_start_as_the_critic_in_other_buffers():
    state = tiny_state()
    jax.tree.map(
        np.testing.assert_array_equal, state.target_critic, state.critic.params
    )
    assert not pointers(state.target_critic) & pointers(state.critic.params)
    assert state.num_updates == 0
    assert state.num_updates.dtype == jnp.int32


def test_the_seed_fixes_all_parameters():
    first, again, other = (tiny_state(seed).params for seed in (0, 0, 1))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    differs = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), first, other)
    assert differs.actor["params"]["head"]["output"]["kernel"]
    assert differs.critic["params"]["trunk"]["project"]["kernel"]


def test_actor_and_critic_trunks_start_differently():
    params = tiny_state().params
    actor, critic = (
        tree["params"]["trunk"]["project"]["kernel"] for tree in params[1:]
    )
    assert actor.shape == critic.shape
    assert np.abs(actor - critic).max() > 1e-2


def test_the_callers_key_outlives_a_donated_state():
    key = jax.random.key(3)
    observation = jnp.zeros(7, jnp.float32)
    state = init_train_state(tiny_learner(), key, observation, SPEC)
    step = jax.jit(make_update_step(tiny_learner()), donate_argnums=0)
    batch = Batch(
        observation=jnp.ones((4, 7)),
        action=jnp.zeros((4, 2)),
        reward=jnp.zeros(4),
        discount=jnp.ones(4),
        next_observation=jnp.ones((4, 7)),
    )
    after, _ = step(state, batch, None)
    assert state.key.is_deleted()
    np.testing.assert_array_equal(
        jax.random.key_data(after.key), jax.random.key_data(key)
    )
