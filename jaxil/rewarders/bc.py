"""Behavioural cloning, a baseline: the policy copies the expert's actions.

The agent never acts in the environment; each update counts as the frames that other
methods play per update.
"""

import chex
import jax
import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.learner.state import TrainState, apply_gradients
from jaxil.learner.update import Learner, UpdateStep
from jaxil.maths import losses
from jaxil.maths.types import Batch, ExpertBatch, Metrics, Params
from jaxil.networks.agent import apply
from jaxil.rewarders.zero import zero_rewards

METHOD = methods.Method(
    name="bc",
    label="BC",
    about="the expert's actions, by behavioural cloning",
    colour="#009E73",
    rank=5,
    sections={"cloning": methods.CLONING},
    make_update_step="make_update_step",
    sees_actions=True,
    plays=False,
    total_updates=55_000,
)


def make_rewarder(agent: AgentSpec, *, batch_size: int, std: float) -> Rewarder:
    """Returns a rewarder of zeros, which asks for expert samples."""
    del agent, std
    return Rewarder(zero_rewards, expert_batch_size=batch_size)


def make_update_step(learner: Learner, *, batch_size: int, std: float) -> UpdateStep:
    """Returns the step that trains encoder and actor on the expert's actions.

    Critic and rewarder are not trained; the agent's batch is None. An update has
    `batch_size` expert samples; for `std` see `losses.cloning_loss`.

    Source: Cohen et al. 2021, sec. 4.1, the BC baseline; siddhanthaldar/ROT,
    agent/bc.py.
    """

    def cloning_step(
        state: TrainState, batch: Batch | None, expert: ExpertBatch | None
    ) -> tuple[TrainState, Metrics]:
        del batch
        assert expert is not None
        chex.assert_rank(expert.action, 2)
        chex.assert_axis_dimension(expert.action, 0, batch_size)
        key = jax.random.fold_in(state.key, state.num_updates)
        return clone(learner, state, expert, expert.action, key, std=std)

    return cloning_step


def clone(
    learner: Learner,
    state: TrainState,
    expert: ExpertBatch,
    action: Array,
    key: Array,
    *,
    std: float,
) -> tuple[TrainState, Metrics]:
    """Trains encoder and actor for one step to answer the expert's observations.

    Args:
      learner: networks and hyperparameters.
      state: its critic and rewarder are not trained.
      expert: its observations are augmented here; its actions are not read.
      action: the answers. Shape [B, A].
      key: of the augmentation; consumed.
      std: see `losses.cloning_loss`.
    """
    encoder, actor, _ = learner.networks
    observation = learner.augment(expert.observation, key)

    def loss(params: tuple[Params, Params]) -> tuple[Array, Array]:
        representation = apply(encoder, params[0], observation)
        pre_tanh = apply(actor, params[1], representation)
        cloning = losses.cloning_loss(jnp.tanh(pre_tanh), action, std=std)
        penalty = losses.saturation_penalty(pre_tanh)
        return cloning + learner.pre_tanh_penalty * penalty, pre_tanh

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
