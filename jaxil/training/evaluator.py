"""Evaluations of a run: episodes of the mean action, with their imitation rewards."""

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
    """One evaluation.

    Attributes:
      evaluation: what was played.
      distance: to the expert, relative to a random policy's; None if unknown.
      sides: of the video; empty without one.
      filmed: arrays that belong to the video, see `Evaluator.explain`.
    """

    evaluation: Evaluation
    distance: float | None
    sides: list[film.Side]
    filmed: dict[str, np.ndarray]


class Evaluator:
    """Evaluates a policy in an environment that training does not use."""

    def __init__(
        self,
        config: Config,
        agent: Agent,
        environment: PixelEnvironment,
        experts: ExpertEpisodes | None,
        distance: ExpertDistance | None,
    ) -> None:
        """See `parts.Parts.make`."""
        self._config = config
        self._agent = agent
        self.environment = environment
        self._experts = experts
        self._distance = distance

    def evaluate(
        self,
        state: TrainState,
        *,
        number: int,
        is_last: bool,
        stop_asked: Callable[[], bool],
    ) -> Result | None:
        """Plays the episodes of one evaluation.

        Args:
          state: the learner's.
          number: evaluations before this one, which fixes the episodes' starts.
          is_last: whether the run ends with it, so that it is filmed.
          stop_asked: asked between agent steps.

        Returns:
          None if it was stopped.
        """
        config = self._config
        encoder, actor = state.policy

        def act(observation: np.ndarray) -> np.ndarray:
            return np.asarray(
                self._agent.mean_action(encoder, actor, observation[None])
            )[0]

        every = config.video_every_evals
        films = every > 0 and (number % every == 0 or is_last)
        first_episode = number * config.num_eval_episodes
        try:
            evaluation = evaluate(
                self.environment,
                act,
                num_episodes=config.num_eval_episodes,
                first_episode=first_episode,
                num_kept=1 if self._distance is None else MAX_EPISODES,
                record=film.recorder(self.environment, film.SIZE) if films else None,
                stop_asked=stop_asked,
            )
            distance, sides, filmed = None, [], {}
            if self._distance is not None:
                distance = self._distance.relative_distance(
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

    def close(self) -> None:
        """Closes the environment."""
        self.environment.close()

    def explain(self, state: TrainState, episode: Episode) -> dict[str, np.ndarray]:
        """Returns an episode's rewards and transport plan, for videos and reports.

        Returns:
          `task_rewards` [T], `imitation_rewards` [T]; `step_seconds`, if known; and if
          the method has one, the transport plan `plan` [T + 1, N + 1] with evenly
          spaced frames of both episodes, `agent_strip` and `expert_strip`
          [10, H, W, 3], if it sees pixels.
        """
        arguments = (state.rewarder, state.params, episode, self._experts)
        found = {
            "task_rewards": episode.rewards,
            "imitation_rewards": np.asarray(self._agent.rewards(*arguments)),
        }
        seconds = self.environment.step_seconds
        if seconds is not None:
            found["step_seconds"] = np.asarray(seconds)
        if self._agent.plan is not None:
            assert self._experts is not None
            plan, index = self._agent.plan(*arguments)
            length = int(self._experts.num_frames[index])
            expert_frames = self._experts.frames[index]
            found["plan"] = plan[:, :length]
            if expert_frames.ndim == 4:
                found["agent_strip"] = _strip(episode.frames)
                found["expert_strip"] = _strip(expert_frames[:length])
        return found


def _strip(frames: np.ndarray) -> np.ndarray:
    """Returns evenly spaced frames of an episode, the first and the last included."""
    times = np.linspace(0, len(frames) - 1, _STRIP_FRAMES).round().astype(int)
    return np.asarray(frames[times])
