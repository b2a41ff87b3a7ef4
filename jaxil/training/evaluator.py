"""Evaluations of a run: episodes of the mean action, with their imitation rewards."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxil.config import Config
from jaxil.environments.evaluation import Evaluation, Stopped, evaluate
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.learner.state import TrainState
from jaxil.maths.types import Episode, ExpertEpisodes
from jaxil.training import film
from jaxil.training.agent import Agent
from jaxil.training.expert_distance import MAX_EPISODES, ExpertDistance

_STRIP_FRAMES = 10


class Result(NamedTuple):
    """One evaluation."""

    evaluation: Evaluation
    distance: float | None  # to the expert, relative to a random policy's, if known
    sides: list[film.Side]  # of the video; empty without one
    filmed: dict[str, np.ndarray]  # beside the video, see `Evaluator.explain`


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """Evaluates a policy in an environment that training does not use."""

    config: Config
    agent: Agent
    environment: PixelEnvironment
    experts: ExpertEpisodes | None
    distance: ExpertDistance | None

    def evaluate(
        self,
        state: TrainState,
        *,
        number: int,
        is_last: bool,
        stop_asked: Callable[[], bool],
    ) -> Result | None:
        """Plays the episodes of one evaluation; returns None if it was stopped.

        Args:
          state: the learner's.
          number: evaluations before this one, which fixes the episodes' starts.
          is_last: whether the run ends with it, so that it is filmed.
          stop_asked: asked between agent steps.
        """
        config = self.config
        encoder, actor = state.policy

        def act(observation: np.ndarray) -> np.ndarray:
            actions = self.agent.mean_action(encoder, actor, observation[None])
            return np.asarray(actions)[0]

        every = config.video_every_evals
        films = every > 0 and (number % every == 0 or is_last)
        first_episode = number * config.num_eval_episodes
        try:
            evaluation = evaluate(
                self.environment,
                act,
                num_episodes=config.num_eval_episodes,
                first_episode=first_episode,
                num_kept=1 if self.distance is None else MAX_EPISODES,
                record=film.recorder(self.environment, film.SIZE) if films else None,
                stop_asked=stop_asked,
            )
            distance, sides, filmed = None, [], {}
            if self.distance is not None:
                distance = self.distance.relative_distance(
                    evaluation.episodes, stop_asked=stop_asked
                )
            if films:
                filmed = self.explain(state, evaluation.episodes[0])
                # Rendering this large takes as long as playing one or two episodes.
                sides = film.sides(
                    config,
                    self.environment,
                    evaluation,
                    first_episode=first_episode,
                    imitation_rewards=filmed["imitation_rewards"],
                    stop_asked=stop_asked,
                )
        except Stopped:
            return None
        return Result(evaluation, distance, sides, filmed)

    def explain(self, state: TrainState, episode: Episode) -> dict[str, np.ndarray]:
        """Returns what videos and reports show of an episode.

        `task_rewards` [T], `imitation_rewards` [T]; `step_seconds`, if known; and if
        the method has one, the transport plan `plan` [T + 1, N + 1], and if it sees
        pixels, `agent_strip` and `expert_strip` [10, H, W, 3], evenly spaced frames.
        """
        arguments = (state.rewarder, state.params, episode, self.experts)
        found = {
            "task_rewards": episode.rewards,
            "imitation_rewards": np.asarray(self.agent.rewards(*arguments)),
        }
        seconds = self.environment.step_seconds
        if seconds is not None:
            found["step_seconds"] = np.asarray(seconds)
        if self.agent.rewarder.plan is not None:
            assert self.experts is not None
            plan, index = self.agent.plan(*arguments)
            length = int(self.experts.num_frames[index])
            expert_frames = self.experts.frames[index]
            found["plan"] = plan[:, :length]
            if expert_frames.ndim == 4:
                found["agent_strip"] = _strip(episode.frames)
                found["expert_strip"] = _strip(expert_frames[:length])
        return found


def _strip(frames: np.ndarray) -> np.ndarray:
    """Returns evenly spaced frames of an episode, the first and the last included."""
    times = np.linspace(0, len(frames) - 1, _STRIP_FRAMES).round().astype(int)
    return np.asarray(frames[times])
