"""One episode of a learned policy beside the expert's, large enough for people."""

import pathlib
from typing import NamedTuple

import numpy as np

from jaxil.demonstrations import playing, rendering, states
from jaxil.environments.interaction import Restorable
from jaxil.training.trained import Trained

_SEED_OF_DRAWING = 0  # what is not in the states: targets, terrain


class Side(NamedTuple):
    """One of the two episodes.

    Attributes:
      name: whose it is.
      frames: uint8 [T + 1, H, W, 3].
      rewards: the task's, [T]; None if unknown.
    """

    name: str
    frames: np.ndarray
    rewards: np.ndarray | None


class Film(NamedTuple):
    """The agent's episode, and the expert's if there is one to show.

    Attributes:
      sides: one or two.
      step_seconds: simulated duration of an agent step; None if unknown.
    """

    sides: tuple[Side, ...]
    step_seconds: float | None

    def captions(self) -> tuple[list[str], ...]:
        """Returns each side's text for each frame: name, time, return so far."""
        return tuple(map(self._captions, self.sides))

    def _captions(self, side: Side) -> list[str]:
        count = len(side.frames)
        texts = [side.name] * count
        if self.step_seconds is not None:
            texts = [
                f"{t}   {k * self.step_seconds:.1f} s" for k, t in enumerate(texts)
            ]
        if side.rewards is not None:
            so_far = np.concatenate([[0.0], np.cumsum(side.rewards)])
            texts = [f"{t}   return {r:.0f}" for t, r in zip(texts, so_far)]
        return texts


def play(run: Trained, image_size: int) -> Film:
    """Plays an episode and renders it and the expert's at quality `paper`.

    A task without simulator states, or an expert of pixels, is shown as the agent sees
    it.

    Args:
      run: the policy and its environment.
      image_size: height and width of the rendered images.
    """
    environment, seconds = run.environment, run.environment.decision_seconds
    begin = lambda _: lambda _, seen: run.act(seen)  # noqa: E731
    if not isinstance(environment, Restorable):
        (episode,) = playing.play_pixels(environment, begin, 1, lambda *_: None)
        side = Side("agent", np.asarray(episode.frames), np.asarray(episode.rewards))
        return Film((side, *_pixels_of_expert(run)), seconds)
    played = playing.play(environment, begin, 1)
    own = {name: played[name] for name in ("qpos", "qvel", "act")}
    sides = [Side("agent", _render(run, own, image_size), played["rewards"][0])]
    path = None
    if run.demonstrations is not None:
        path = pathlib.Path(run.demonstrations.metadata["file"])
    if path is None or not states.recognises(path):
        return Film((*sides, *_pixels_of_expert(run)), seconds)
    expert = states.read_states(path, num_episodes=1)
    stride = run.config.action_repeat // expert.metadata["action_repeat"]
    shown = expert.simulator_states(slice(None, None, stride))
    rewards = expert.rewards[0]
    whole = len(rewards) // stride * stride
    rewards = rewards[:whole].reshape(-1, stride).sum(axis=1)
    sides.append(Side("expert", _render(run, shown, image_size), rewards))
    return Film(tuple(sides), seconds)


def _render(run: Trained, shown: dict[str, np.ndarray], image_size: int) -> np.ndarray:
    return rendering.observe_episodes(
        shown,
        task=run.config.task,
        seed=_SEED_OF_DRAWING,
        first_episode=0,
        image_size=image_size,
        render_quality="paper",
    )[0]


def _pixels_of_expert(run: Trained) -> tuple[Side, ...]:
    demonstrations = run.demonstrations
    if demonstrations is None or demonstrations.frames.ndim != 5:
        return ()
    length = demonstrations.num_frames[0]
    rewards = demonstrations.task_rewards
    return (
        Side(
            "expert",
            demonstrations.frames[0, :length],
            None if rewards is None else rewards[0, : length - 1],
        ),
    )
