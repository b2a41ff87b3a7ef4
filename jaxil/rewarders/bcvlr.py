"""BCV-LR, behavioural cloning from videos via latent representations.

A latent action encodes what the video's next observation adds to the one before. The
agent's own experience shows which action each stands for, and the policy clones those.
There is neither a reward nor a critic.
"""

from collections.abc import Mapping
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder, Spec
from jaxil.learner.state import (
    ModuleState,
    TrainState,
    apply_gradients,
    copy_params,
    init_module,
)
from jaxil.learner.update import Learner, UpdateStep
from jaxil.maths import augmentation, cloning, losses, quantisation
from jaxil.maths.types import Batch, ExpertBatch, Metrics, Params
from jaxil.networks.agent import AgentNetworks, apply
from jaxil.networks.discriminator import Embedding
from jaxil.networks.latent_action import LatentActionModel
from jaxil.rewarders import bc
from jaxil.rewarders.zero import zero_rewards

METHOD = methods.Method(
    name="bcvlr",
    label="BCV-LR",
    about="actions decoded from latent ones, which are learned from the video",
    colour="#7FB800",
    rank=14,
    sections={
        "cloning": methods.CLONING,
        "latent": {
            "num_parts": methods.Field(
                8,
                "of a latent action, each with codes of its own; 8 in the authors' "
                "code, which share two codebooks",
                1,
                1000,
            ),
            "num_codes": methods.Field(
                64, "of each part; 64 in the authors' code", 2, 65_536
            ),
            "part_dim": methods.Field(
                16, "numbers in a part; 16 in the authors' code", 1, 10_000
            ),
            "hidden_dim": methods.Field(
                1024, "width of inverse and forward model; 1024 as the actor", 1, 10**5
            ),
            "learning_rate": methods.Field(
                3e-4,
                "of its Adam; 3e-4 on the video, 1e-3 on play in the authors' code",
                0,
                1,
                positive=True,
            ),
            "commitment": methods.Field(
                0.05, "its weight; 0.05 in the authors' code", 0, 1e6
            ),
            "prediction_weight": methods.Field(
                1.0,
                "of the losses on the video, beside the decoder's; 1 in the authors' "
                "code, which adds no decoder loss there",
                0,
                1e6,
            ),
            "target_tau": methods.Field(
                0.05,
                "update rate of the slow copy; 0.05 in the authors' code",
                0,
                1,
                positive=True,
            ),
        },
    },
    make_update_step="make_update_step",
    metrics=(
        "latent/prediction",
        "latent/distance",
        "latent/codes_used",
        "latent/error",
    ),
)

_SIZES = ("num_parts", "num_codes", "part_dim", "hidden_dim")  # of its model


class LatentState(struct.PyTreeNode):
    """What the method learns.

    Attributes:
      live: of the embedding and of the latent-action model: a tuple, under one Adam.
      target: slow copy of the embedding, whose features are predicted.
    """

    live: ModuleState
    target: Params


def make_rewarder(
    agent: AgentSpec,
    *,
    batch_size: int,
    learning_rate: float,
    **fields: Any,
) -> Rewarder:
    """Returns a rewarder of zeros, whose state is the latent-action model.

    For the arguments see `make_update_step`.
    """
    sizes = {name: fields[name] for name in _SIZES}
    embedding, model = _modules(agent.networks, sizes)

    def init(key: Array, spec: Spec, *_: Any) -> LatentState:
        keys = jax.random.split(key)
        observation = jnp.zeros((1, *spec.observation_shape))
        embed = embedding.init(keys[0], observation)
        features = apply(embedding, embed, observation)
        params = embed, model.init(keys[1], features, features)
        live = init_module(params, optax.adam(learning_rate))
        return LatentState(live, copy_params(embed))

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
    learning_rate: float,
    commitment: float,
    prediction_weight: float,
    target_tau: float,
    **sizes: Any,
) -> UpdateStep:
    """Returns the step that trains all parts at once; the critic is not used.

    With an embedding h, its slow copy h', the inverse model g, the nearest codes Q, the
    forward model f and the decoder d, and z = g(h(e_t), h(e_{t+1})):

        min    w (prediction_loss(f(h(e_t), Q(z)), h'(e_{t+1}))
                  + codebook_loss(z, Q(z)) + beta commitment_loss(z, Q(z)))
               + mean |d(g(h(o_t), h(o_{t+1}))) - a_t|^2
        max_pi mean log pi(d(z) | e_t)

    over the expert's pairs e, whose actions are not read, and the agent's transitions
    (o, a). As in the authors' code, the forward model gets the codes, but the decoder
    the latent action before quantisation, because actions are continuous.

    Differences from the publication, so that acting, evaluation and export are as for
    every method and frame counts compare:

    - It trains in stages: the encoder on the video with a loss of prototypes, then
      latent actions, then, every 1000 decisions, inverse model and decoder on play and
      the policy on the video. Here each update of the agent trains everything. Without
      the loss of prototypes, prediction and decoder train the encoder too, and the
      prediction could shrink its own targets to a constant. The targets are therefore a
      slow copy's features in standard deviations: see `losses.prediction_loss`.
    - Its encoder is frozen after the first stage, and latent actions and policy share
      it. Here the actor has the agent's own encoder, which cloning trains.
    - Its policy outputs latent actions, which the decoder translates. Here the actor
      regresses the decoded actions directly.
    - It moves codes to a moving average of their latents. Here `codebook_loss` does.
    - It also trains the forward model on play, with a weight of 1e-5 or 1e-3.

    Args:
      learner: networks and hyperparameters.
      batch_size: expert samples; those of the agent are `config.batch_size`.
      std: see `losses.cloning_loss`.
      learning_rate: of the Adam of all that is not the agent's.
      commitment: beta.
      prediction_weight: w.
      target_tau: h' <- h' + tau (h - h') after each step.
      **sizes: `num_parts`, `num_codes`, `part_dim` and `hidden_dim` of
        `LatentActionModel`.

    Source: Liu et al. 2025, arXiv:2512.21586; liuxin0824/BCV-LR, run_offline.py and
    run_online.py.
    """
    embedding, model = _modules(learner.networks, sizes)
    optimiser = optax.adam(learning_rate)

    def infer(
        params: tuple[Params, Params], pair: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Returns the features of the first observation, and the latent action."""
        features = [apply(embedding, params[0], observation) for observation in pair]
        return features[0], apply(model, params[1], *features, method=model.infer)

    def on_video(
        params: tuple[Params, Params], pair: tuple[Array, Array], target: Array
    ) -> tuple[Array, Array, Metrics]:
        """Returns the loss, the decoded actions and metrics."""
        features, latent = infer(params, pair)
        indices = apply(model, params[1], latent, method=model.nearest)
        code = apply(model, params[1], indices, method=model.codes)
        passed = quantisation.straight_through(latent, code)
        predicted = apply(model, params[1], features, passed, method=model.predict)
        error = losses.prediction_loss(predicted, target)
        distance = quantisation.codebook_loss(latent, code)
        committed = quantisation.commitment_loss(latent, code)
        action = apply(model, params[1], latent, method=model.decode)
        used = quantisation.perplexity(indices, num_codes=model.num_codes)
        metrics = {
            "latent/prediction": error,
            "latent/distance": distance,
            "latent/codes_used": used,
        }
        return error + distance + commitment * committed, action, metrics

    def on_play(
        params: tuple[Params, Params], pair: tuple[Array, Array], action: Array
    ) -> Array:
        """Returns the decoder's squared error on the agent's transitions."""
        _, latent = infer(params, pair)
        decoded = apply(model, params[1], latent, method=model.decode)
        return cloning.inference_error(decoded, action)

    def bcvlr_step(
        state: TrainState, batch: Batch | None, expert: ExpertBatch | None
    ) -> tuple[TrainState, Metrics]:
        assert batch is not None
        assert batch.successor is not None
        assert expert is not None
        assert expert.successor is not None
        chex.assert_axis_dimension(expert.observation, 0, batch_size)
        step_key = jax.random.fold_in(state.key, state.num_updates)
        play_key, video_key, expert_key = jax.random.split(step_key, 3)
        padding = learner.shift_padding
        play = augmentation.augment_pair(
            batch.observation, batch.successor, play_key, padding=padding
        )
        video = augmentation.augment_pair(
            expert.observation, expert.successor, video_key, padding=padding
        )
        target = apply(embedding, state.rewarder.target, video[1])

        def loss(params: tuple[Params, Params]) -> tuple[Array, tuple[Array, Metrics]]:
            unsupervised, labels, metrics = on_video(params, video, target)
            error = on_play(params, play, batch.action)
            metrics["latent/error"] = error
            return prediction_weight * unsupervised + error, (labels, metrics)

        # Labels from before this step's update, so that the video is embedded once.
        gradients, (labels, metrics) = jax.grad(loss, has_aux=True)(
            state.rewarder.live.params
        )
        live = apply_gradients(state.rewarder.live, gradients, optimiser)
        slow = optax.incremental_update(
            live.params[0], state.rewarder.target, target_tau
        )
        state = state.replace(rewarder=LatentState(live, slow))
        state, cloning_metrics = bc.clone(
            learner, state, expert, labels, expert_key, std=std
        )
        return state, {**cloning_metrics, **metrics}

    return bcvlr_step


def _modules(
    networks: AgentNetworks, sizes: Mapping[str, Any]
) -> tuple[Embedding, LatentActionModel]:
    actor = networks.actor
    model = LatentActionModel(
        **sizes, feature_dim=actor.feature_dim, action_dim=actor.action_dim
    )
    return Embedding(networks.encoder, actor.feature_dim), model
