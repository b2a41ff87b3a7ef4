"""PatchAIL: rewards from a discriminator of patches of pixels."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, AgentView, Rewarder, Spec
from jaxil.learner.state import LearnerParams, ModuleState
from jaxil.maths.types import AnyEpisode, ExpertBatch, Metrics, Params
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import PatchDiscriminator
from jaxil.rewarders.discrimination import (
    Pair,
    TransitionJudge,
    make_transition_rewarder,
    mean_logit,
    scaled,
)

METHOD = methods.Method(
    name="patchail",
    label="PatchAIL",
    about="adversarial rewards on patches of pixels",
    colour="#117733",
    rank=10,
    sections={
        "discriminator": {
            "variant": methods.Field(
                "plain",
                "plain: the mean logit of all patches; weighted (PatchAIL-W), bonus "
                "(PatchAIL-B): with their similarity to the expert's",
                choices=("plain", "weighted", "bonus"),
            ),
            "width": methods.Field(
                32,
                "channels of its first layer; the next have 2 and 4 times as many; 32 "
                "in the paper",
                1,
                10_000,
            ),
            "learning_rate": methods.DISCRIMINATOR["learning_rate"],
            "gradient_penalty": methods.DISCRIMINATOR["gradient_penalty"],
            "batch_size": methods.DISCRIMINATOR["batch_size"],
            "relabels": methods.RELABELS._replace(default=False),
        }
    },
    needs_pixels=True,
    metrics=methods.DISCRIMINATOR_METRICS,
    variations=(
        methods.Variation("discriminator.variant", "plain", "{}"),
        methods.Variation("discriminator.relabels", False, "relabelled rewards"),
    ),
)

_FIRST_SIMILARITY = {"weighted": 1.3, "bonus": 0.5}


class SimilarityState(ModuleState):
    """The discriminator, and what similarity is measured with.

    Attributes:
      expert_patches: D of the expert's patches, averaged over the last update's samples
        and normalised to sum to one. Shape [P].
      scale: lambda, set by the first episode; 0 before. Shape [].
    """

    expert_patches: Array
    scale: Array


def make_rewarder(
    agent: AgentSpec, *, variant: str, width: int, **training: Any
) -> Rewarder:
    """Returns the rewarder of PatchAIL, PatchAIL-W or PatchAIL-B.

        plain      r_t = m_t,    m_t = mean over patches of logit D(o_t, o_{t+1})
        weighted   r_t = s_t m_t
        bonus      r_t = 0.5 m_t + s_t

    where s_t is lambda times `patch_similarity`, and lambda makes the first episode's
    mean s 1.3 (weighted) or 0.5 (bonus). The penalty is on the mean logit as a function
    of pixels in [0, 1]; the authors' is on the sum of logits, of pixels in [0, 255].

    Args:
      agent: its frame stack and shift are used.
      variant: "plain", "weighted" or "bonus".
      width: see `PatchDiscriminator`.
      **training: see `make_transition_rewarder`.

    Source: Liu et al. 2023, Visual Imitation Learning with Patch Rewards,
    arXiv:2302.00965, and its code, sail-sg/PatchAIL, where the first batch sets lambda,
    and every update recomputes s for its batch although the logits are stored.
    """
    discriminator = PatchDiscriminator(width)
    smooth = discriminator.clone(by_windows=True)

    def init_params(key: Array, spec: Spec) -> Params:
        *size, channels = spec.observation_shape
        return discriminator.init(key, jnp.zeros((1, *size, 2 * channels)))

    def logits(params: Params, pair: Pair) -> Array:
        return apply(discriminator, params, scaled(jnp.concatenate(pair, axis=-1)))

    def penalised(params: Params, pair: Pair) -> Array:
        return apply(smooth, params, jnp.concatenate(pair, axis=-1))

    def reward(state: SimilarityState, logits: Array) -> Array:
        mean = mean_logit(logits)
        if variant == "plain":
            return mean
        s = state.scale * patch_similarity(logits, state.expert_patches)
        return s * mean if variant == "weighted" else 0.5 * mean + s

    judge = TransitionJudge(init_params, logits, penalised, reward=reward)
    plain = make_transition_rewarder(agent, judge, **training)
    if variant == "plain":
        return plain

    def init(key: Array, spec: Spec, learner: LearnerParams) -> SimilarityState:
        state = plain.init(key, spec, learner)
        pixels = jnp.zeros((1, *spec.observation_shape))
        patches = jax.eval_shape(logits, state.params, (pixels, pixels)).shape[1]
        return SimilarityState(
            params=state.params,
            opt_state=state.opt_state,
            expert_patches=jnp.full(patches, 1.0 / patches),
            scale=jnp.zeros(()),
        )

    def update(
        state: SimilarityState,
        learner: LearnerParams,
        view: AgentView,
        expert: ExpertBatch | None,
        key: Array,
    ) -> tuple[SimilarityState, Metrics]:
        new, metrics = plain.update(state, learner, view, expert, key)
        assert expert is not None
        pair = jnp.asarray(expert.observation), jnp.asarray(expert.successor)
        probabilities = jnp.mean(jax.nn.sigmoid(logits(new.params, pair)), axis=0)
        patches = probabilities / jnp.sum(probabilities)
        return new.replace(expert_patches=patches), metrics

    def observe(
        state: SimilarityState, learner: LearnerParams, episode: AnyEpisode, *_: Any
    ) -> SimilarityState:
        del learner

        def first_scale() -> Array:
            x = agent.stack_frames(episode.frames)
            of_patches = logits(state.params, (x[:-1], x[1:]))
            found = patch_similarity(of_patches, state.expert_patches)
            own = jnp.arange(len(found)) < episode.num_steps
            mean = jnp.sum(jnp.where(own, found, 0.0)) / episode.num_steps
            return _FIRST_SIMILARITY[variant] / mean

        scale = jax.lax.cond(state.scale > 0.0, lambda: state.scale, first_scale)
        return state.replace(scale=scale)

    return plain._replace(init=init, update=update, observe=observe)


def patch_similarity(logits: Array, expert_patches: Array) -> Array:
    """Returns how similar distributions over patches are to the expert's.

        exp(-KL(p | q)),    p = D / sum over patches of D,    D = sigmoid(logits)

    Args:
      logits: of the agent's patches. Shape [B, P].
      expert_patches: q, positive and summing to one. Shape [P].

    Returns:
      Similarities in (0, 1]. Shape [B].

    Source: Liu et al. 2023, eq. (7), as in sail-sg/PatchAIL, agent/adv_irl.py.
    """
    chex.assert_rank([logits, expert_patches], [2, 1])
    chex.assert_equal_shape_suffix([logits, expert_patches], 1)
    log_d = jax.nn.log_sigmoid(logits)
    log_p = log_d - jax.nn.logsumexp(log_d, axis=1, keepdims=True)
    divergence = jnp.exp(log_p) * (log_p - jnp.log(expert_patches)[None])
    return jnp.exp(-jnp.sum(divergence, axis=1))
