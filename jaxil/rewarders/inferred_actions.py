"""Cloning of inferred actions, added to any method that rewards.

Inverse models learn from the agent's own play which action leads from one observation
to the next, as in BCO, and infer the actions of the expert's video. The actor then
follows rewards and, as far as those inferred actions are trusted, copies them.
"""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import (
    AgentSpec,
    AgentView,
    Rewarder,
    RewarderState,
    Spec,
)
from jaxil.learner.state import (
    LearnerParams,
    ModuleState,
    apply_gradients,
    init_module,
)
from jaxil.maths import augmentation, cloning
from jaxil.maths.types import ExpertBatch, Metrics, Params
from jaxil.networks.agent import apply
from jaxil.networks.inverse_model import InverseModels

# Folded into keys that the inner method gets too. `split(key)[n]` may be
# `fold_in(key, n)`, so a small number could be one of the inner method's own.
_OWN_KEY = 2**31


class CloningState(struct.PyTreeNode):
    """The state of the method that rewards, and the inverse models.

    Attributes:
      inner: the other method's.
      models: of `InverseModels`.
    """

    inner: RewarderState
    models: ModuleState


def add_cloning(make_inner: Callable[..., Rewarder]) -> Callable[..., Rewarder]:
    """Returns `make_rewarder` of a method with `with_cloning`: it takes both's fields.

    Args:
      make_inner: the method's own (agent, **fields) -> rewarder.
    """
    own = {*methods.PSEUDO_ACTIONS, *methods.INVERSE_MODELS}

    def make_rewarder(agent: AgentSpec, **fields: Any) -> Rewarder:
        """Returns the inner method's rewarder with `with_cloning`.

        `fields` are the inner method's, and those of `with_cloning`.
        """
        cloning = {name: fields.pop(name) for name in own & fields.keys()}
        return with_cloning(make_inner(agent, **fields), agent, **cloning)

    return make_rewarder


def with_cloning(
    rewarder: Rewarder,
    agent: AgentSpec,
    *,
    num_pairs: int,
    weight: float,
    trust: str,
    trust_scale: float,
    num_models: int,
    head_dim: int,
    model_learning_rate: float,
) -> Rewarder:
    """Returns a rewarder with the same rewards; its actor also clones inferred actions.

        min_g   mean_m mean_t |g_m(o_t, o_{t+1}) - a_t|^2      over the agent's samples
        L_actor = ... + weight s mean_t w_t mean_a (pi(e_t) - label_t)_a^2
        label_t = mean_m g_m(e_t, e_{t+1})

    with the trust w in a label and s = `cloning.value_scale` of the agent's samples.
    The inverse models have an encoder of their own. The expert's actions are not read
    here, but the inner method may read them.

    An update gets as many expert samples as the inner method asks for, or `num_pairs`
    if that is more; each uses the first rows. The inner method is given the random
    keys, samples and states that it would have alone: with weight 0 the agent learns as
    with the inner method, but for rounding.

    Args:
      rewarder: the inner method.
      agent: its networks say what encoder and embedding the inverse models have.
      num_pairs: expert transitions whose inferred actions are cloned in an update.
      weight: of the term.
      trust: "agreement": `cloning.agreement_trust`; "q_filter": `cloning.q_filter`,
        by the critic that the actor's loss uses; "none": 1.
      trust_scale: of "agreement"; models that have learned nothing are about 0.05
        apart, with two actions as with six, so at 0.01 they are hardly trusted.
      num_models: M, inverse models; they share encoder and embedding.
      head_dim: width of their separate heads.
      model_learning_rate: of their Adam.

    Source: Torabi et al. 2018, arXiv:1805.01954, for inferred actions; ROT
    (siddhanthaldar/ROT), where the expert's actions are known, for cloning beside
    imitation rewards. The combination is this project's own.
    """
    encoder, actor, critic = agent.networks
    models = InverseModels(
        encoder, agent.feature_dim, head_dim, actor.action_dim, num_models
    )
    optimiser = optax.adam(model_learning_rate)
    expert_batch_size = max(rewarder.expert_batch_size, num_pairs)

    def inner_samples(
        view: AgentView, expert: ExpertBatch
    ) -> tuple[AgentView, ExpertBatch | None]:
        """Returns what the inner method asks for."""
        if not rewarder.samples_successors:
            view = view._replace(
                successor=None, successor_features=None, unshifted_successor=None
            )
            expert = expert._replace(successor=None)
        if not rewarder.expert_batch_size:
            return view, None
        return view, _first_rows(expert, rewarder.expert_batch_size)

    def infer(params: Params, expert: ExpertBatch) -> Array:
        """Returns each model's inferred actions, [M, B, A]."""
        pairs = _first_rows(expert, num_pairs)
        return apply(models, params, pairs.observation, pairs.successor)

    def init(key: Array, spec: Spec, learner: LearnerParams) -> CloningState:
        observation = jnp.zeros((1, *spec.observation_shape))
        params = models.init(
            jax.random.fold_in(key, _OWN_KEY), observation, observation
        )
        return CloningState(
            rewarder.init(key, spec, learner), init_module(params, optimiser)
        )

    def update(
        state: CloningState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[CloningState, Metrics]:
        assert expert is not None
        assert view.unshifted_successor is not None
        chex.assert_axis_dimension(expert.observation, 0, expert_batch_size)
        inner, metrics = rewarder.update(
            state.inner, learner, *inner_samples(view, expert), key
        )
        pair = augmentation.augment_pair(
            view.unshifted,
            view.unshifted_successor,
            jax.random.fold_in(key, _OWN_KEY),
            padding=agent.shift_padding,
        )

        def loss(params: Params) -> Array:
            return cloning.inference_error(apply(models, params, *pair), view.action)

        error, gradients = jax.value_and_grad(loss)(state.models.params)
        agreement = cloning.agreement_trust(
            cloning.disagreement(infer(state.models.params, expert)), scale=trust_scale
        )
        state = CloningState(inner, apply_gradients(state.models, gradients, optimiser))
        return state, {
            **metrics,
            "inverse_model/error": error,
            "inverse_model/agreement": jnp.mean(agreement),
        }

    def actor_loss(
        state: CloningState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> Array:
        assert expert is not None
        inferred = infer(state.models.params, expert)
        label = jnp.mean(inferred, axis=0)
        observation = agent.augment(
            jnp.asarray(expert.observation)[:num_pairs],
            jax.random.fold_in(key, _OWN_KEY),
        )
        representation = apply(encoder, learner.encoder, observation)
        action = jnp.tanh(apply(actor, learner.actor, representation))

        def values(features: Array, taken: Array) -> Array:
            return apply(critic, learner.critic, features, taken, method=critic.values)

        if trust == "agreement":
            distance = cloning.disagreement(inferred)
            trusted = cloning.agreement_trust(distance, scale=trust_scale)
        elif trust == "q_filter":
            features = apply(
                critic, learner.critic, representation, method=critic.features
            )
            trusted = cloning.q_filter(
                values(features, label), values(features, action)
            )
        else:
            trusted = jnp.ones(num_pairs)
        # These features are from before this update; for a scale that is enough.
        scale = cloning.value_scale(values(view.features, view.action))
        term = weight * scale * cloning.trusted_cloning_loss(action, label, trusted)
        if rewarder.actor_loss is None:
            return term
        samples = inner_samples(view, expert)
        return term + rewarder.actor_loss(state.inner, learner, *samples, key)

    def observe(state: CloningState, *arguments: Any) -> CloningState:
        return state.replace(inner=rewarder.observe(state.inner, *arguments))

    def of_inner(function: Any) -> Any:
        """Returns an inner function of the whole state; None where there is none."""
        if function is None:
            return None
        return lambda state, *arguments: function(state.inner, *arguments)

    return Rewarder(
        of_inner(rewarder.rewards),
        init,
        update,
        observe,
        expert_batch_size=expert_batch_size,
        matches_episodes=rewarder.matches_episodes,
        samples_successors=True,
        ignores_padding=rewarder.ignores_padding,
        relabel=of_inner(rewarder.relabel),
        rewards_changed=of_inner(rewarder.rewards_changed),
        actor_loss=actor_loss,
        plan=of_inner(rewarder.plan),
        summary=of_inner(rewarder.summary),
    )


def _first_rows(expert: ExpertBatch, count: int) -> ExpertBatch:
    return jax.tree.map(lambda values: jnp.asarray(values)[:count], expert)
