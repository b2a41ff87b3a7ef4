"""Cloning of inferred actions, weighted by how far each is trusted."""

import chex
import jax
import jax.numpy as jnp
from jax import Array


def inference_error(inferred: Array, action: Array) -> Array:
    """Returns the mean squared error of inferred actions on the agent's own samples.

        E = mean |g(o_t, o_{t+1}) - a_t|^2

    The squares are summed over the action's numbers; the mean is over samples and
    models.

    Args:
      inferred: of one model [B, A], or of M models [M, B, A].
      action: what the agent did. Shape [B, A].

    Source: Torabi et al. 2018, arXiv:1805.01954, sec. 4.1: maximum likelihood, for
    Gaussian actions of fixed variance.
    """
    chex.assert_rank([inferred, action], [{2, 3}, 2])
    chex.assert_equal_shape_suffix([inferred, action], 2)
    action = jnp.broadcast_to(action, inferred.shape)
    return jnp.mean(jnp.sum(jnp.square(inferred - action), axis=-1))


def disagreement(actions: Array) -> Array:
    """Returns the variance of the models' actions for each transition, [B].

        d_b = sum_a var_m g_m(e_b, e'_b)_a,    var_m x = mean_m (x_m - mean_m x)^2

    Args:
      actions: of M models for B transitions, in [-1, 1]. Shape [M, B, A].

    Returns:
      In [0, A]: 0 where all models agree.

    Source: Brantley et al. 2020, "Disagreement-regularized imitation learning", ICLR:
    the variance of an ensemble of policies; here it is one of inverse models.
    """
    chex.assert_rank(actions, 3)
    return jnp.sum(jnp.var(actions, axis=0), axis=1)


def agreement_trust(distance: Array, *, scale: float) -> Array:
    """Returns the trust in labels, given their models' disagreement, [B].

        w_b = exp(-d_b / scale),    in [0, 1]

    Args:
      distance: see `disagreement`. Shape [B].
      scale: the disagreement at which trust has fallen to 1/e.

    Source: none; the form is this project's own.
    """
    chex.assert_rank(distance, 1)
    return jnp.exp(-distance / scale)


def q_filter(label_values: Array, policy_values: Array) -> Array:
    """Returns 1 where the critic prefers the label to the policy's action, else 0, [B].

        w_b = 1 if min_k Q_k(e_b, label_b) > min_k Q_k(e_b, pi(e_b)) else 0

    Args:
      label_values: both critics on the labels. Shape [2, B].
      policy_values: both critics on the policy's actions. Shape [2, B].

    Source: the Q-filter of Nair et al. 2018, arXiv:1709.10089, with the smaller of two
    critics. ROT (siddhanthaldar/ROT) has one number for a batch instead: how often the
    critic prefers a cloned policy's action to the agent's, on the agent's observations.
    """
    chex.assert_rank([label_values, policy_values], 2)
    chex.assert_equal_shape([label_values, policy_values])
    label, policy = (jnp.min(q, axis=0) for q in (label_values, policy_values))
    return (label > policy).astype(label.dtype)


def trusted_cloning_loss(action: Array, label: Array, trust: Array) -> Array:
    """Returns the mean squared distance of the policy from labels, weighted by trust.

        L = mean_b w_b mean_a (pi(e_b) - label_b)_a^2

    The mean is over all samples, so the term fades where few labels are trusted, and
    over the action's numbers, so it is at most 4.

    Args:
      action: the policy's mean action. Shape [B, A].
      label: without gradient. Shape [B, A].
      trust: w, in [0, 1], without gradient. Shape [B].

    Source: the cloning term of TD3+BC, Fujimoto and Gu 2021, arXiv:2106.06860, with
    trust; the mean over the action is that of their code (sfujim/TD3_BC).
    """
    chex.assert_rank([action, label, trust], [2, 2, 1])
    chex.assert_equal_shape([action, label])
    chex.assert_equal_shape([action[:, 0], trust])
    label, trust = jax.lax.stop_gradient((label, trust))
    return jnp.mean(trust * jnp.mean(jnp.square(action - label), axis=1))


def value_scale(values: Array) -> Array:
    """Returns the mean size of values [2, B], without gradient.

        s = mean_b |min_k Q_k(o_b, a_b)|

    Multiplied by it, a term keeps its share of the actor's loss if all rewards are
    multiplied by a number. If a number is added to them, it does not.

    Source: TD3+BC, Fujimoto and Gu 2021, arXiv:2106.06860, which divides the other term
    by it.
    """
    chex.assert_rank(values, 2)
    return jax.lax.stop_gradient(jnp.mean(jnp.abs(jnp.min(values, axis=0))))
