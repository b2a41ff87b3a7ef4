"""The average of a run's policies, which is evaluated in place of the newest."""

import chex
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.learner.state import PolicyParams, TrainState, copy_params
from jaxil.learner.update import UpdateStep
from jaxil.maths.types import Batch, ExpertBatch, Metrics


def average_policy(
    average: PolicyParams, newest: PolicyParams, num_updates: Array, *, tau: float
) -> PolicyParams:
    """Returns the average after one more update.

        a_n = a_{n-1} + max(tau, 1 / n) (p_n - a_{n-1})

    This is the mean of all policies for 1 / tau updates, then an exponential average.

    Args:
      average: a_{n-1}; ignored where n is 1, but must be finite.
      newest: p_n.
      num_updates: n, at least 1. Shape [].
      tau: weight of the newest policy once n exceeds 1 / tau.

    Source: Polyak and Juditsky 1992 average iterates; of policies, e.g. Lillicrap et
    al. 2016 (DDPG's target actor). Here the average is only evaluated.
    """
    chex.assert_rank(num_updates, 0)
    chex.assert_trees_all_equal_shapes(average, newest)
    share = jnp.maximum(tau, 1.0 / num_updates)
    pairs = zip(newest, average, strict=True)
    return PolicyParams(*(optax.incremental_update(*pair, share) for pair in pairs))


def begin_average(state: TrainState) -> TrainState:
    """Returns the state with its newest policy as the first average."""
    return state.replace(average=copy_params(state.newest_policy))


def make_averaging_step(step: UpdateStep, *, tau: float) -> UpdateStep:
    """Returns any method's learning step, which then also averages its policies."""

    def averaging_step(
        state: TrainState, batch: Batch, expert: ExpertBatch | None
    ) -> tuple[TrainState, Metrics]:
        state, metrics = step(state, batch, expert)
        assert state.average is not None
        average = average_policy(
            state.average, state.newest_policy, state.num_updates, tau=tau
        )
        return state.replace(average=average), metrics

    return averaging_step
