"""Losses and targets on arrays."""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import Array

_NORM_FLOOR = 1e-12  # added under the root: d|g|/dg is undefined at g = 0
_STD_FLOOR = 1e-6  # makes a constant feature 0 instead of NaN


def td_target(reward: Array, discount: Array, next_values: Array) -> Array:
    """Returns the clipped double-Q target over n steps, without gradient.

        y = R_n + gamma^n * min_k Q_k(o', a')

    Args:
      reward: R_n, discounted sum of the window's rewards. Shape [B].
      discount: gamma^n times the environment's discounts, in [0, 1]. Shape [B].
      next_values: both target critics after the window. Shape [2, B].

    Source: Yarats et al. 2021, arXiv:2107.09645, eq. (1).
    """
    chex.assert_rank([reward, discount, next_values], [1, 1, 2])
    chex.assert_equal_shape([reward, discount, next_values[0]])
    bootstrap = jnp.min(next_values, axis=0)
    return jax.lax.stop_gradient(reward + discount * bootstrap)


def critic_loss(values: Array, target: Array) -> Array:
    """Returns the summed mean squared errors of values [2, B] from targets [B].

        L = sum_k mean_b (Q_k - y)^2

    Source: Yarats et al. 2021, arXiv:2107.09645, eq. (1); no factor 1/2, as in the
    authors' code.
    """
    chex.assert_rank([values, target], [2, 1])
    chex.assert_equal_shape([values[0], target])
    return jnp.sum(jnp.mean(jnp.square(values - target[None]), axis=1))


def actor_loss(values: Array) -> Array:
    """Returns minus the mean of the smaller of the two values [2, B].

    Source: Yarats et al. 2021, arXiv:2107.09645, eq. (2).
    """
    chex.assert_rank(values, 2)
    return -jnp.mean(jnp.min(values, axis=0))


def saturation_penalty(pre_tanh: Array) -> Array:
    """Returns the mean square of the actor's mean before its tanh, [B, A].

    Where |pre-tanh| is large, the gradient of tanh vanishes and the actor is stuck at
    a saturated action. The paper does not have this penalty: its weight is 0 there.
    """
    chex.assert_rank(pre_tanh, 2)
    return jnp.mean(jnp.square(pre_tanh))


def discriminator_loss(expert_logits: Array, agent_logits: Array) -> Array:
    """Returns binary cross-entropy with label 1 for the expert.

    With logits l = log D - log(1 - D):  -log D = softplus(-l)  and
    -log(1 - D) = softplus(l), both finite for every l.

    Both batches of logits have shape [B]; the loss is the sum of their means.

    Source: Cohen et al. 2021, eq. (7), with the labels that eq. (8) needs: taken
    literally, the two equations would reward the agent for differing from the expert.
    """
    chex.assert_rank([expert_logits, agent_logits], 1)
    chex.assert_equal_shape([expert_logits, agent_logits])
    expert_term = jnp.mean(jax.nn.softplus(-expert_logits))
    agent_term = jnp.mean(jax.nn.softplus(agent_logits))
    return expert_term + agent_term


def gradient_penalty(
    logits: Callable[[Any], Array], expert: Any, agent: Any, key: Array
) -> Array:
    """Returns the mean squared difference between the input gradient's norm and one.

        x_i = u_i e_i + (1 - u_i) a_i,   u_i ~ Uniform(0, 1)
        L   = mean_i (|d l(x_i) / d x_i| - 1)^2

    Inputs of several arrays (pixels and an action) count as one long vector.

    Args:
      logits: maps a batch of inputs to [B]; rows are independent.
      expert: discriminator inputs from demonstrations: a pytree of float arrays, each
        of shape [B, ...].
      agent: the agent's, alike.
      key: consumed.

    Source: Gulrajani et al. 2017, arXiv:1704.00028, eq. (3).
    """
    chex.assert_trees_all_equal_shapes_and_dtypes(expert, agent)
    leaves = jax.tree.leaves(expert)
    chex.assert_equal_shape_prefix(leaves, 1)
    mix = jax.random.uniform(key, leaves[0].shape[:1], leaves[0].dtype)

    def blend(e: Array, a: Array) -> Array:
        share = mix.reshape(-1, *[1] * (e.ndim - 1))
        return share * e + (1.0 - share) * a

    between = jax.tree.map(blend, expert, agent)
    # Rows are independent, so the gradient of the sum holds the gradient of each.
    gradients = jax.grad(lambda x: jnp.sum(logits(x)))(between)
    squares = [
        jnp.sum(jnp.square(g), axis=tuple(range(1, g.ndim)))
        for g in jax.tree.leaves(gradients)
    ]
    norms = jnp.sqrt(sum(squares) + _NORM_FLOOR)
    return jnp.mean(jnp.square(norms - 1.0))


def cloning_loss(mean: Array, action: Array, *, std: float) -> Array:
    """Returns minus the log-probability of the expert's actions.

        L = mean_b sum_a (x - m)^2 / (2 s^2) + log s + log(2 pi) / 2

    with the policy's mean m and fixed std s, and the expert's action x. Shapes [B, A].

    Source: siddhanthaldar/ROT, agent/bc.py; the paper gives neither loss nor s.
    """
    chex.assert_rank([mean, action], 2)
    chex.assert_equal_shape([mean, action])
    return -jnp.mean(jnp.sum(jax.scipy.stats.norm.logpdf(action, mean, std), axis=1))


def prediction_loss(prediction: Array, features: Array) -> Array:
    """Returns the mean squared error of predicted features, in standard deviations.

        L = mean_bd (p_bd - (z_bd - m_d) / s_d)^2

    with mean m and standard deviation s of each feature over the batch. A prediction
    that is the same for every row has at best L = 1, however small s is (above 1e-6),
    so shrinking the features to a constant gains nothing. Features that all carry the
    same information are not prevented.

    Args:
      prediction: p. Shape [B, D].
      features: z, without gradient. Shape [B, D].

    Source: the squared error is that of liuxin0824/BCV-LR, models.py,
    `WorldModel.label`, whose features the error does not train and which therefore
    needs no standard deviations.
    """
    chex.assert_rank([prediction, features], 2)
    chex.assert_equal_shape([prediction, features])
    features = jax.lax.stop_gradient(features)
    centred = features - jnp.mean(features, axis=0, keepdims=True)
    std = jnp.std(features, axis=0, keepdims=True)
    return jnp.mean(jnp.square(prediction - centred / (std + _STD_FLOOR)))
