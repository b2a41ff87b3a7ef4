"""The learning step of DrQ-v2, with a rewarder's own step inside it."""

import dataclasses
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.learner.rewarder import AgentView, Rewarder, Spec
from jaxil.learner.state import (
    LearnerParams,
    TrainState,
    apply_gradients,
    copy_params,
    init_module,
)
from jaxil.maths import augmentation, distributions, losses
from jaxil.maths.types import Batch, Data, ExpertBatch, Metrics, Params
from jaxil.networks.agent import AgentNetworks, apply, critic_features

_SUCCESSOR_KEY = 2**30

UpdateStep = Callable[
    [TrainState, Batch, ExpertBatch | None], tuple[TrainState, Metrics]
]


@dataclasses.dataclass(frozen=True)
class Learner:
    """What training does not change: constants of the compiled step.

    Attributes:
      networks: encoder, actor and critic.
      rewarder: the imitation method.
      learning_rate: of each network's own Adam, or its schedule by update number.
      critic_target_tau: share of the new critic in the target, each update.
      noise_clip: bound of the exploration noise in updates.
      shift_padding: largest random shift, in pixels.
      pre_tanh_penalty: weight of `losses.saturation_penalty`; 0 in the paper.
      exploration_std: standard deviation by update number.
    """

    networks: AgentNetworks
    rewarder: Rewarder
    learning_rate: optax.ScalarOrSchedule
    critic_target_tau: float
    noise_clip: float
    shift_padding: int
    pre_tanh_penalty: float
    exploration_std: optax.Schedule

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam, the same for each network."""
        return optax.adam(self.learning_rate)

    def augment(self, observation: Data, key: Array) -> Array:
        """Returns observations [B, ...] after the random shift."""
        return augmentation.augment(observation, key, padding=self.shift_padding)


def init_train_state(
    learner: Learner, key: Array, observation: Data, spec: Spec
) -> TrainState:
    """Returns the state before the first update.

    `key` becomes its base key; `observation` is an example, without batch axis.
    """
    networks = learner.networks
    # Larger than all update numbers, so no random number is used twice.
    encoder_key, actor_key, critic_key, rewarder_key = jax.random.split(
        jax.random.fold_in(key, 2**32 - 1), 4
    )
    batch = jnp.asarray(observation)[None]
    encoder = networks.encoder.init(encoder_key, batch)
    representation = apply(networks.encoder, encoder, batch)
    actor = networks.actor.init(actor_key, representation)
    action = jnp.zeros((1, spec.action_dim))
    critic = networks.critic.init(critic_key, representation, action)
    params = LearnerParams(encoder, actor, critic)
    optimiser = learner.optimiser
    return TrainState(
        encoder=init_module(encoder, optimiser),
        actor=init_module(actor, optimiser),
        critic=init_module(critic, optimiser),
        target_critic=copy_params(critic),
        rewarder=learner.rewarder.init(rewarder_key, spec, params),
        key=jax.random.clone(key),  # the caller may still use its own
        num_updates=jnp.zeros((), jnp.int32),
    )


def make_update_step(learner: Learner) -> UpdateStep:
    """Returns the learning step, to be jitted with its state donated.

    The order is that of the references: relabel, if the method does; augment; rewarder
    on pre-update features; critic, which alone trains the encoder; actor with the
    updated critic on the pre-update representation; target critic last.
    """

    def update_step(
        state: TrainState, batch: Batch, expert: ExpertBatch | None
    ) -> tuple[TrainState, Metrics]:
        chex.assert_rank([batch.action, batch.reward, batch.discount], [2, 1, 1])
        chex.assert_equal_shape([batch.observation, batch.next_observation])
        step_key = jax.random.fold_in(state.key, state.num_updates)
        shift_key, next_key, target_key, actor_key, rewarder_key = jax.random.split(
            step_key, 5
        )
        std = jnp.asarray(learner.exploration_std(state.num_updates), jnp.float32)
        before = state.params
        unshifted = batch.observation
        if learner.rewarder.relabel is not None:
            assert batch.window is not None
            rewards = learner.rewarder.relabel(state.rewarder, before, batch)
            chex.assert_equal_shape([rewards, batch.window.weight])
            reward = jnp.sum(batch.window.weight * rewards, axis=1)
            batch = batch._replace(reward=jax.lax.stop_gradient(reward))
        batch = batch._replace(
            observation=learner.augment(batch.observation, shift_key),
            next_observation=learner.augment(batch.next_observation, next_key),
        )

        state, representation, features, critic_metrics = _update_critic(
            learner, state, batch, std, target_key
        )
        agent = AgentView(batch.observation, features, batch.action, unshifted)
        if learner.rewarder.samples_successors:
            agent = _with_successors(learner, before, batch, agent, rewarder_key)
        state, actor_metrics = _update_actor(
            learner, state, representation, std, actor_key, agent, expert
        )
        # Written last, since it needs the critic's features, but as if it came first:
        # all values are from before this update.
        rewarder, rewarder_metrics = learner.rewarder.update(
            state.rewarder, before, agent, expert, rewarder_key
        )
        state = state.replace(
            rewarder=rewarder,
            target_critic=optax.incremental_update(
                state.critic.params, state.target_critic, learner.critic_target_tau
            ),
            num_updates=state.num_updates + 1,
        )
        return state, {
            **critic_metrics,
            **actor_metrics,
            **rewarder_metrics,
            "exploration_std": std,
        }

    return update_step


def _with_successors(
    learner: Learner, before: LearnerParams, batch: Batch, agent: AgentView, key: Array
) -> AgentView:
    """Adds the fields of `AgentView` that describe successors."""
    assert batch.successor is not None
    # A separate key, so that no other random number depends on successors. The method
    # splits `key` too, and `split(key)[n]` may be `fold_in(key, n)`.
    successor_key = jax.random.fold_in(key, _SUCCESSOR_KEY)
    successor = learner.augment(batch.successor, successor_key)
    features = critic_features(
        learner.networks, before.encoder, before.critic, successor
    )
    return agent._replace(
        successor=successor,
        successor_features=jax.lax.stop_gradient(features),
        unshifted_successor=batch.successor,
    )


def _update_critic(
    learner: Learner, state: TrainState, batch: Batch, std: Array, key: Array
) -> tuple[TrainState, Array, Array, Metrics]:
    """Steps critic and encoder.

    Returns:
      The state; the representation [B, R] and the critic's features [B, D] of the
      observations, from before the step and without gradient; metrics.
    """
    encoder, actor, critic = learner.networks
    # There is no target encoder: next observations pass through the live one.
    next_representation = apply(encoder, state.encoder.params, batch.next_observation)
    next_mean = jnp.tanh(apply(actor, state.actor.params, next_representation))
    next_action = distributions.sample_truncated_normal(
        next_mean, std, key, noise_clip=learner.noise_clip
    )
    next_values = apply(critic, state.target_critic, next_representation, next_action)
    target = losses.td_target(batch.reward, batch.discount, next_values)

    def loss(params: tuple[Params, Params]) -> tuple[Array, tuple[Array, ...]]:
        encoder_params, critic_params = params
        representation = apply(encoder, encoder_params, batch.observation)
        features = apply(critic, critic_params, representation, method=critic.features)
        values = apply(
            critic, critic_params, features, batch.action, method=critic.values
        )
        return losses.critic_loss(values, target), (representation, features, values)

    (value, (representation, features, values)), gradients = jax.value_and_grad(
        loss, has_aux=True
    )((state.encoder.params, state.critic.params))
    optimiser = learner.optimiser
    state = state.replace(
        encoder=apply_gradients(state.encoder, gradients[0], optimiser),
        critic=apply_gradients(state.critic, gradients[1], optimiser),
    )
    metrics = {
        "critic/loss": value,
        "critic/value": jnp.mean(values),
        "critic/target": jnp.mean(target),
        "batch/reward": jnp.mean(batch.reward),
    }
    stop = jax.lax.stop_gradient
    return state, stop(representation), stop(features), metrics


def _update_actor(
    learner: Learner,
    state: TrainState,
    representation: Array,
    std: Array,
    key: Array,
    agent: AgentView,
    expert: ExpertBatch | None,
) -> tuple[TrainState, Metrics]:
    """Steps the actor on the updated critic's values and the method's own term."""
    _, actor, critic = learner.networks

    def loss(params: Params) -> tuple[Array, Array]:
        pre_tanh = apply(actor, params, representation)
        action = distributions.sample_truncated_normal(
            jnp.tanh(pre_tanh), std, key, noise_clip=learner.noise_clip
        )
        values = apply(critic, state.critic.params, representation, action)
        penalty = losses.saturation_penalty(pre_tanh)
        total = losses.actor_loss(values) + learner.pre_tanh_penalty * penalty
        if learner.rewarder.actor_loss is not None:
            total += learner.rewarder.actor_loss(
                state.rewarder,
                state.params._replace(actor=params),
                agent,
                expert,
                jax.random.fold_in(key, 1),
            )
        return total, pre_tanh

    (value, pre_tanh), gradients = jax.value_and_grad(loss, has_aux=True)(
        state.actor.params
    )
    actor_state = apply_gradients(state.actor, gradients, learner.optimiser)
    return state.replace(actor=actor_state), {
        "actor/loss": value,
        # Watch this: beyond about 3 the actor is stuck at a saturated action.
        "actor/pre_tanh": jnp.mean(jnp.abs(pre_tanh)),
    }
