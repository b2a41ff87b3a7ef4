"""Shared by adversarial methods: the discriminator's step, rewards of transitions."""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.learner.rewarder import AgentSpec, AgentView, Rewarder, RewarderState, Spec
from jaxil.learner.state import (
    LearnerParams,
    Module,
    ModuleState,
    apply_gradients,
    init_module,
)
from jaxil.maths import losses
from jaxil.maths.types import (
    AnyEpisode,
    Batch,
    Data,
    ExpertBatch,
    Metrics,
    Params,
)
from jaxil.networks.encoder import PixelEncoder

# Parameters and inputs to logits: [B], or [B, P] if each part of an input has one.
Logits = Callable[[Params, Any], Array]
Pair = tuple[Array, Array]  # discriminator inputs from o_t and from o_{t+1}


def update_discriminator(
    state: Module,
    logits: Logits,
    expert: Any,
    agent: Any,
    key: Array,
    *,
    penalty_weight: float,
    optimiser: optax.GradientTransformation,
    penalised: Logits | None = None,
) -> tuple[Module, Metrics]:
    """Takes one step towards telling expert (label 1) from agent (label 0).

        max_D  mean log D(e) + mean log(1 - D(a)) - penalty_weight * GP

    Where an input has several logits, means are over these too, and the penalty is on
    the mean logit.

    Args:
      state: the discriminator.
      logits: maps parameters and inputs to logits.
      expert: inputs of demonstrations, a pytree of arrays [B, ...]: pixels in
        [0, 255], vectors.
      agent: the same of the agent. No gradient flows into either.
      key: consumed.
      penalty_weight: weight of `losses.gradient_penalty`; 10 in the paper.
      optimiser: of the discriminator.
      penalised: maps parameters and inputs with pixels in [0, 1] to the same logits,
        by operations that may be differentiated twice; `logits` if no input is pixels.

    Source: Cohen et al. 2021, eq. (7).
    """
    expert, agent = jax.lax.stop_gradient((expert, agent))
    smooth = penalised or logits

    def loss(params: Params) -> tuple[Array, Metrics]:
        together = jax.tree.map(lambda *x: jnp.concatenate(x), expert, agent)
        expert_logits, agent_logits = jnp.split(logits(params, together), 2)
        cross_entropy = losses.discriminator_loss(
            expert_logits.ravel(), agent_logits.ravel()
        )
        penalty = losses.gradient_penalty(
            lambda x: mean_logit(smooth(params, x)),
            jax.tree.map(scaled, expert),
            jax.tree.map(scaled, agent),
            key,
        )
        metrics = {
            "discriminator/loss": cross_entropy,
            "discriminator/penalty": penalty,
            "discriminator/expert_logit": jnp.mean(expert_logits),
            "discriminator/agent_logit": jnp.mean(agent_logits),
        }
        return cross_entropy + penalty_weight * penalty, metrics

    gradients, metrics = jax.grad(loss, has_aux=True)(state.params)
    return apply_gradients(state, gradients, optimiser), metrics


def mean_logit(logits: Array) -> Array:
    """Returns the mean over all axes but the first."""
    return jnp.mean(logits, axis=tuple(range(1, logits.ndim)))


def scaled(observation: Data) -> Array:
    """Returns pixels in [0, 1], as gradient penalties assume; states as they are."""
    observation = jnp.asarray(observation)
    if observation.ndim == 2:
        return observation
    return observation.astype(jnp.float32) / 255.0


def unscaled(x: Array) -> Array:
    """Undoes `scaled`: returns pixels in [0, 255], as encoders take them."""
    return x if x.ndim == 2 else 255.0 * x


def twice_differentiable(encoder: Any) -> Any:
    """Returns the encoder in a form that a penalty may differentiate twice."""
    if not isinstance(encoder, PixelEncoder):
        return encoder
    return encoder.clone(native=False, by_windows=True)


class TransitionJudge(NamedTuple):
    """A discriminator D of transitions; by default of observations x = o.

    Attributes:
      init: (key, spec) -> parameters of D.
      logits: (parameters, (x_t, x_{t+1})) -> logits [M], or [M, P].
      penalised: see `update_discriminator`.
      inputs: (learner, observations [M, ...]) -> x [M, ...].
      agent_inputs: (view) -> the agent's x_t and x_{t+1}, [B, ...].
      reward: (state, logits) -> rewards [M]; the state has D's parameters.
    """

    init: Callable[[Array, Spec], Params]
    logits: Logits
    penalised: Logits | None = None
    inputs: Callable[[LearnerParams, Array], Array] = lambda _, observation: observation
    agent_inputs: Callable[[AgentView], tuple[Array | None, Array | None]] = (
        lambda view: (view.observation, view.successor)
    )
    reward: Callable[[RewarderState, Array], Array] = lambda _, logits: logits


def make_transition_rewarder(
    agent: AgentSpec,
    judge: TransitionJudge,
    *,
    learning_rate: float,
    gradient_penalty: float,
    batch_size: int,
    relabels: bool,
) -> Rewarder:
    """Returns the rewarder of a discriminator of transitions.

        r_t = judge.reward(logits D(x_t, x_{t+1}))

    D is trained on augmented observations, but rewards are of observations without
    augmentation.

    Args:
      agent: its frame stack and shift are used.
      judge: D, and what it sees.
      learning_rate, gradient_penalty, batch_size: see `methods.DISCRIMINATOR`.
      relabels: whether rewards are recomputed for every batch; otherwise they are
        stored.
    """
    optimiser = optax.adam(learning_rate)

    def init(key: Array, spec: Spec, *_: Any) -> ModuleState:
        return init_module(judge.init(key, spec), optimiser)

    def update(
        state: ModuleState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[ModuleState, Metrics]:
        assert expert is not None
        assert expert.successor is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        chex.assert_equal_shape([expert.observation, expert.successor])
        *keys, penalty_key = jax.random.split(key, 3)
        observations = expert.observation, expert.successor
        return update_discriminator(
            state,
            judge.logits,
            tuple(
                judge.inputs(learner, augmented)
                for augmented in map(agent.augment, observations, keys)
            ),
            jax.tree.map(lambda x: x[:batch_size], judge.agent_inputs(view)),
            penalty_key,
            penalty_weight=gradient_penalty,
            optimiser=optimiser,
            penalised=judge.penalised,
        )

    def reward(state: ModuleState, pair: Pair) -> Array:
        return judge.reward(state, judge.logits(state.params, pair))

    def rewards(
        state: ModuleState, learner: LearnerParams, episode: AnyEpisode, *_: Any
    ) -> Array:
        x = judge.inputs(learner, agent.stack_frames(episode.frames))
        return reward(state, (x[:-1], x[1:]))

    def relabel(state: ModuleState, learner: LearnerParams, batch: Batch) -> Array:
        window = batch.window
        assert window is not None
        chex.assert_equal_shape_prefix([window.observation, window.action], 2)
        moments = [window.observation, batch.next_observation[:, None]]
        moments = jnp.concatenate(moments, axis=1)  # [B, n + 1, ...]
        size = moments.shape[:2]
        x = judge.inputs(learner, moments.reshape(-1, *moments.shape[2:]))
        x = x.reshape(*size, *x.shape[1:])
        now, after = (y.reshape(-1, *y.shape[2:]) for y in (x[:, :-1], x[:, 1:]))
        return reward(state, (now, after)).reshape(window.action.shape[:2])

    return Rewarder(
        rewards,
        init,
        update,
        expert_batch_size=batch_size,
        samples_successors=True,
        ignores_padding=True,
        relabel=relabel if relabels else None,
        rewards_changed=None if relabels else lambda state: True,
    )
