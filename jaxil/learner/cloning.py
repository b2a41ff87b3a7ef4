"""Behavioural cloning: the learning step of the baseline that never plays."""

import chex
import jax
import jax.numpy as jnp
from jax import Array

from jaxil.learner.state import TrainState, apply_gradients
from jaxil.learner.update import Learner, UpdateStep
from jaxil.maths import augmentation, losses
from jaxil.maths.types import Batch, ExpertBatch, Metrics, Params
from jaxil.networks.agent import apply


def make_cloning_step(learner: Learner, *, std: float) -> UpdateStep:
    """Returns the step that trains encoder and actor on the expert's actions.

    Critic and rewarder stay as they were made; the batch of the agent is None.

    Args:
      learner: networks and hyperparameters.
      std: see `losses.cloning_loss`.

    Source: Cohen et al. 2021, sec. 4.1, the BC baseline; siddhanthaldar/ROT,
    agent/bc.py.
    """

    def cloning_step(
        state: TrainState, batch: Batch | None, expert: ExpertBatch | None
    ) -> tuple[TrainState, Metrics]:
        del batch
        assert expert is not None
        chex.assert_rank(expert.action, 2)
        observation = augmentation.augment(
            expert.observation,
            jax.random.fold_in(state.key, state.num_updates),
            padding=learner.shift_padding,
        )
        encoder, actor, _ = learner.networks

        def loss(params: tuple[Params, Params]) -> tuple[Array, Array]:
            representation = apply(encoder, params[0], observation)
            pre_tanh = apply(actor, params[1], representation)
            negative = losses.cloning_loss(jnp.tanh(pre_tanh), expert.action, std=std)
            penalty = losses.saturation_penalty(pre_tanh)
            return negative + learner.pre_tanh_penalty * penalty, pre_tanh

        (value, pre_tanh), gradients = jax.value_and_grad(loss, has_aux=True)(
            (state.encoder.params, state.actor.params)
        )
        optimiser = learner.optimiser
        state = state.replace(
            encoder=apply_gradients(state.encoder, gradients[0], optimiser),
            actor=apply_gradients(state.actor, gradients[1], optimiser),
            num_updates=state.num_updates + 1,
        )
        return state, {
            "actor/loss": value,
            "actor/pre_tanh": jnp.mean(jnp.abs(pre_tanh)),
        }

    return cloning_step
