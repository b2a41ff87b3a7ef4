"""BCO, behavioural cloning from observation: the agent clones inferred actions.

An inverse model learns from the agent's own play which action leads from one
observation to the next, labels the demonstrations with it, and the policy clones those
labels. There is neither a reward nor a critic.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.state import (
    ModuleState,
    TrainState,
    apply_gradients,
    init_module,
)
from jaxil.learner.update import Learner, UpdateStep
from jaxil.maths import augmentation, cloning
from jaxil.maths.types import Batch, ExpertBatch, Metrics, Params
from jaxil.networks.agent import AgentNetworks, apply
from jaxil.networks.inverse_model import InverseModel
from jaxil.rewarders import bc
from jaxil.rewarders.zero import zero_rewards

METHOD = methods.Method(
    name="bco",
    label="BCO",
    about="actions inferred from the video by an inverse model of the agent's own play",
    colour="#AA4499",
    rank=13,
    sections={
        "cloning": methods.CLONING,
        "inverse_model": {
            "hidden_dim": methods.Field(1024, "width of its hidden layers", 1, 10**5),
            "learning_rate": methods.Field(1e-4, "of its Adam", 0, 1, positive=True),
        },
    },
    make_update_step="make_update_step",
    metrics=("inverse_model/error",),
)


def make_rewarder(
    agent: AgentSpec,
    *,
    batch_size: int,
    std: float,
    hidden_dim: int,
    learning_rate: float,
) -> Rewarder:
    """Returns a rewarder of zeros, whose state is the inverse model.

    For the arguments see `make_update_step`.
    """
    del std
    model = _inverse_model(agent.networks, hidden_dim)

    def init(key: Array, spec: Spec, *_: Any) -> ModuleState:
        observation = jnp.zeros((1, *spec.observation_shape))
        params = model.init(key, observation, observation)
        return init_module(params, optax.adam(learning_rate))

    return Rewarder(
        zero_rewards,
        init,
        expert_batch_size=batch_size,
        samples_successors=True,
        ignores_padding=True,
    )


def make_update_step(
    learner: Learner,
    *,
    batch_size: int,
    std: float,
    hidden_dim: int,
    learning_rate: float,
) -> UpdateStep:
    """Returns the step that trains inverse model and policy; the critic is not used.

        min_g  mean |g(o_t, o_{t+1}) - a_t|^2          over the agent's transitions
        max_pi mean log pi(g(e_t, e_{t+1}) | e_t)      over the expert's

    BCO alternates between collecting episodes and training to convergence. Here each
    agent update trains both once, so that frame counts compare with other methods'. How
    diverse the play is depends on the run's exploration.

    Args:
      learner: the inverse model has an encoder like its networks'.
      batch_size: expert samples; those of the agent are `config.batch_size`.
      std: see `losses.cloning_loss`.
      hidden_dim: width of the inverse model.
      learning_rate: of its Adam.

    Source: Torabi et al. 2018, arXiv:1805.01954, algorithm 1, BCO(alpha).
    """
    model = _inverse_model(learner.networks, hidden_dim)
    optimiser = optax.adam(learning_rate)

    def bco_step(
        state: TrainState, batch: Batch | None, expert: ExpertBatch | None
    ) -> tuple[TrainState, Metrics]:
        assert batch is not None
        assert batch.successor is not None
        assert expert is not None
        assert expert.successor is not None
        chex.assert_equal_shape([expert.observation, expert.successor])
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        step_key = jax.random.fold_in(state.key, state.num_updates)
        pair_key, expert_key = jax.random.split(step_key)
        pair = augmentation.augment_pair(
            batch.observation, batch.successor, pair_key, padding=learner.shift_padding
        )

        def loss(params: Params) -> Array:
            return cloning.inference_error(apply(model, params, *pair), batch.action)

        error, gradients = jax.value_and_grad(loss)(state.rewarder.params)
        inverse = apply_gradients(state.rewarder, gradients, optimiser)
        labels = apply(model, inverse.params, expert.observation, expert.successor)
        state = state.replace(rewarder=inverse)
        state, metrics = bc.clone(learner, state, expert, labels, expert_key, std=std)
        return state, {**metrics, "inverse_model/error": error}

    return bco_step


def _inverse_model(networks: AgentNetworks, hidden_dim: int) -> InverseModel:
    actor = networks.actor
    return InverseModel(
        networks.encoder, actor.feature_dim, hidden_dim, actor.action_dim
    )
