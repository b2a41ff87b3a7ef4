"""What a method returns, against its interface."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxil.errors import MethodError
from jaxil.learner.checked import checked_rewarder
from jaxil.learner.rewarder import Rewarder
from jaxil.maths.types import Episode

_EPISODE = Episode(np.zeros((5, 3)), np.zeros((4, 2)), np.zeros(4), np.ones(4))
_ANY: Any = None  # what the functions here do not read
_STATE = {"count": jnp.zeros((), jnp.int32)}


def _rewarder(**functions) -> Rewarder:
    def rewards(state, learner, episode, experts):
        return jnp.ones(episode.actions.shape[0])

    return checked_rewarder("mine", Rewarder(**{"rewards": rewards, **functions}))


@pytest.mark.parametrize(
    ("found", "named"),
    [
        (jnp.ones(5), r"shape \(5,\)"),
        (jnp.ones((4, 1)), r"shape \(4, 1\)"),
        (jnp.ones(()), r"shape \(\)"),
        (None, "NoneType"),
    ],
)
def test_rewards_are_one_for_each_step(found, named):
    rewarder = _rewarder(rewards=lambda *_: found)
    with pytest.raises(
        MethodError, match=f"mine: `rewards` returned {named}.*4 actions"
    ):
        jax.eval_shape(rewarder.rewards, _STATE, _ANY, _EPISODE, None)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda state: {"count": state["count"] + 0.5}, r"\['count'\] is float32\[\]"),
        (lambda state: {"count": jnp.zeros(2, jnp.int32)}, r"is int32\[2\], was int32"),
        (lambda state: {}, r"\['count'\] is missing, was int32\[\]"),
        (lambda state: {**state, "more": jnp.ones(1)}, r"\['more'\] is float32\[1\]"),
        (lambda state: {**state, "more": None}, "its structure differs"),
    ],
)
def test_a_state_stays_what_init_made_it(change, named):
    """Else its checkpoint would not load: that of `init` says what is expected."""
    rewarder = _rewarder(
        observe=lambda state, *_: change(state),
        update=lambda state, *_: (change(state), {}),
    )
    with pytest.raises(MethodError, match=f"mine: `observe` .*{named}"):
        jax.eval_shape(rewarder.observe, _STATE, _ANY, _EPISODE, None)
    with pytest.raises(MethodError, match=f"mine: `update` .*{named}"):
        jax.eval_shape(rewarder.update, _STATE, _ANY, _ANY, None, _ANY)


@pytest.mark.parametrize(
    "error", [KeyError("weight"), SystemExit(3), TypeError("two\nlines")]
)
@pytest.mark.parametrize("part", ["rewards", "init", "summary", "rewards_changed"])
def test_an_error_of_ones_own_method_is_one_message(error, part):
    def fail(*arguments):
        raise error

    def rewards(state, learner, episode, experts):
        return jnp.ones(4)

    plain = Rewarder(**{"rewards": rewards, part: fail})
    own = checked_rewarder("my.module:METHOD", plain)
    arguments = [_ANY] * (4 if part == "rewards" else 3 if part == "init" else 1)
    with pytest.raises(MethodError, match=f"error in `{part}`: .*test_checked") as said:
        getattr(own, part)(*arguments)
    assert "\n" not in str(said.value)
    with pytest.raises(type(error)):  # of jaxil's own methods it is a fault of jaxil's
        getattr(checked_rewarder("mine", plain), part)(*arguments)


@pytest.mark.parametrize(
    ("found", "named"),
    [
        (None, "returned NoneType; expected scalars by name"),
        ({"mine/a": None}, "'mine/a' of NoneType"),
        ({"mine/a": np.zeros(2)}, r"'mine/a' of shape \(2,\)"),
    ],
)
def test_a_summary_is_of_scalars(found, named):
    with pytest.raises(MethodError, match=named):
        _rewarder(summary=lambda state: found).summary(_STATE)


def test_what_keeps_the_interface_passes_unchanged():
    rewarder = _rewarder(
        observe=lambda state, *_: {"count": state["count"] + 1},
        update=lambda state, *_: (state, {"mine/loss": jnp.ones(())}),
    )
    np.testing.assert_array_equal(
        rewarder.rewards(_STATE, _ANY, _EPISODE, None), np.ones(4)
    )
    assert rewarder.observe(_STATE, _ANY, _EPISODE, None) == {"count": 1}
    assert rewarder.update(_STATE, _ANY, _ANY, None, _ANY) == (
        _STATE,
        {"mine/loss": 1.0},
    )


@pytest.mark.parametrize(
    ("update", "named"),
    [
        (lambda state, *_: state, r"`update` returned dict; expected \(state, metrics"),
        (lambda state, *_: (state, jnp.ones(2)), "`update` returned tuple; expected"),
        (
            lambda state, *_: (state, {"own/error": jnp.ones(2)}),
            r"the metric 'own/error' of shape \(2,\); expected a scalar",
        ),
        (
            lambda state, learner, view, expert, key: (state, {"a/b": expert.action}),
            "no expert samples unless `expert_batch_size` is set",
        ),
    ],
)
def test_an_update_returns_a_state_and_scalars(update, named):
    rewarder = _rewarder(update=update)
    with pytest.raises(MethodError, match=f"mine: .*{named}"):
        jax.eval_shape(rewarder.update, _STATE, _ANY, _ANY, None, _ANY)
