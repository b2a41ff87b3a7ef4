"""What a method returns, checked where it is traced: mistakes of one's own methods."""

import contextlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxil.errors import MethodError, told_as
from jaxil.learner.rewarder import Rewarder
from jaxil.maths.types import AnyEpisode, ExpertBatch, Metrics


def checked_rewarder(name: str, rewarder: Rewarder) -> Rewarder:
    """Returns the rewarder, which raises MethodError where it breaks its interface.

    Shapes and types are checked once per compilation: rewards are [T], metrics are
    scalars, and `observe` and `update` return a state like the one that they got. With
    another state training would go on, but its checkpoint could not be restored. An
    error that a user's own method raises becomes a MethodError too.

    Args:
      name: of the method, for the message; with a colon it is the user's own.
      rewarder: see `Rewarder`.
    """

    def rewards(state: Any, learner: Any, episode: AnyEpisode, experts: Any) -> Array:
        found = rewarder.rewards(state, learner, episode, experts)
        expected, shape = (episode.actions.shape[0],), getattr(found, "shape", None)
        if shape != expected:
            what = type(found).__name__ if shape is None else f"shape {shape}"
            raise MethodError(
                f"{name}: `rewards` returned {what} for an episode of {expected[0]} "
                "actions, padding included; expected one reward for each, shape "
                f"{expected}"
            )
        return jnp.asarray(found)

    def observe(state: Any, *arguments: Any) -> Any:
        return _like(name, "observe", state, rewarder.observe(state, *arguments))

    def update(
        state: Any, learner: Any, view: Any, expert: ExpertBatch | None, key: Array
    ) -> tuple[Any, Metrics]:
        try:
            found = rewarder.update(state, learner, view, expert, key)
        except AttributeError as error:
            if expert is not None or "'NoneType'" not in str(error):
                raise
            words = "`update` gets no expert samples unless `expert_batch_size` is set"
            raise MethodError(f"{name}: {words} ({error})") from error
        is_pair = isinstance(found, tuple) and len(found) == 2
        if not (is_pair and isinstance(found[1], Mapping)):
            what = type(found).__name__
            raise MethodError(
                f"{name}: `update` returned {what}; expected (state, metrics by name)"
            )
        _require_scalars(name, "update", found[1])
        return _like(name, "update", state, found[0]), found[1]

    def summary(state: Any) -> Metrics:
        found = rewarder.summary(state)
        if not isinstance(found, Mapping):
            what = type(found).__name__
            raise MethodError(
                f"{name}: `summary` returned {what}; expected scalars by name"
            )
        _require_scalars(name, "summary", found)
        return found

    checked = rewarder._replace(
        rewards=rewards, observe=observe, update=update, summary=summary
    )
    hooks = {part: f for part, f in checked._asdict().items() if callable(f)}
    return checked._replace(**{part: _told(name, part, f) for part, f in hooks.items()})


def _require_scalars(name: str, function: str, metrics: Mapping[str, Any]) -> None:
    for metric, value in metrics.items():
        if value is None or isinstance(value, str):
            what = type(value).__name__
        elif shape := jnp.shape(value):
            what = f"shape {shape}"
        else:
            continue
        raise MethodError(
            f"{name}: `{function}` returned the metric {metric!r} of {what}; expected "
            "a scalar"
        )


def told(name: str, part: str) -> contextlib.AbstractContextManager[None]:
    """Tells errors in a method's function as one message, if it is the user's own.

    Of jaxil's and installed methods they are faults that need a traceback.
    """
    if ":" not in name:
        return contextlib.nullcontext()
    return told_as(name, f"`{part}`", MethodError)


def _told(name: str, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any) -> Any:
        with told(name, part):
            return function(*arguments)

    return call


def _like(name: str, function: str, before: Any, after: Any) -> Any:
    old, new = _described(before), _described(after)
    changed = [
        f"{key or 'the state'} is {new.get(key, 'missing')}, was {old.get(key, 'none')}"
        for key in dict.fromkeys([*old, *new])
        if old.get(key) != new.get(key)
    ]
    if changed or jax.tree.structure(before) != jax.tree.structure(after):
        raise MethodError(
            f"{name}: `{function}` returned a state unlike that of `init`: "
            f"{'; '.join(changed) or 'its structure differs'}"
        )
    return after


def _described(state: Any) -> dict[str, str]:
    return {
        jax.tree_util.keystr(path): f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}"
        for path, leaf in jax.tree_util.tree_leaves_with_path(state)
    }
