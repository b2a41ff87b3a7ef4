"""One episode of a learned policy beside the expert's, large enough for people."""

from typing import NamedTuple

import numpy as np
from PIL import Image

from jaxil.demonstrations import playing, rendering
from jaxil.demonstrations.loading import Demonstrations
from jaxil.environments.interaction import Restorable
from jaxil.machine.progress import shown
from jaxil.training import assembly
from jaxil.training.trained import Trained

_VIEW_SHARE = 0.3  # of a side, for what the agent itself sees
_FRAME = 1  # pixels around it


class Side(NamedTuple):
    """One of the two episodes.

    Attributes:
      frames: uint8 [T + 1, H, W, 3].
      captions: whose it is, time and return so far, for each frame.
    """

    frames: np.ndarray
    captions: list[str]


def agent_side(run: Trained, image_size: int) -> Side:
    """Plays an episode and renders it large, at the quality of the run.

    What the agent sees is in the lower right corner. A task without simulator states is
    shown as the agent sees it.

    Args:
      run: the policy and its environment.
      image_size: height and width of the rendered images.
    """
    environment, config = run.environment, run.config
    views: list[np.ndarray] = []

    def act(step: int, observation: np.ndarray) -> np.ndarray:
        del step
        if observation.ndim == 3:
            views.append(observation[..., -3:])  # the newest of the stack
        return run.act(observation)

    if not isinstance(environment, Restorable):
        episodes = playing.play_pixels(environment, lambda _: act, 1, lambda *_: None)
        (episode,) = episodes
        frames, rewards = np.asarray(episode.frames), episode.rewards
    else:
        played = playing.play(environment, lambda _: act, 1)
        with shown("rendering the agent's episode") as show:
            (frames,) = rendering.observe_episodes(
                {name: played[name] for name in ("qpos", "qvel", "act")},
                task=config.task,
                seed=config.seed + assembly.EVALUATION_SEED,
                first_episode=0,
                image_size=image_size,
                render_quality=config.render_quality,
                camera=config.camera,
                cache=False,
                progress=show,
            )
        (rewards,) = played["rewards"]
        if views:
            _inset(frames, views)
    return Side(frames, _captions("agent", len(frames), rewards, _seconds(run)))


def expert_side(run: Trained, expert: Demonstrations) -> Side:
    """Returns the first demonstration, as `assembly.load_shown_expert` loads it."""
    length = expert.num_frames[0]
    rewards = None if expert.task_rewards is None else expert.task_rewards[0]
    return Side(
        expert.frames[0, :length], _captions("expert", length, rewards, _seconds(run))
    )


def _seconds(run: Trained) -> float | None:
    return run.environment.decision_seconds


def _captions(
    name: str, count: int, rewards: np.ndarray | None, step_seconds: float | None
) -> list[str]:
    texts = [name] * count
    if step_seconds is not None:
        texts = [f"{t}   {k * step_seconds:.1f} s" for k, t in enumerate(texts)]
    if rewards is not None:
        so_far = np.concatenate([[0.0], np.cumsum(rewards)])[:count]
        texts = [f"{t}   return {r:.0f}" for t, r in zip(texts, so_far)]
    return texts


def _inset(frames: np.ndarray, views: list[np.ndarray]) -> None:
    """Draws what the agent sees into the corner of each frame."""
    side = round(_VIEW_SHARE * frames.shape[1])
    for index, frame in enumerate(frames):
        view = Image.fromarray(views[min(index, len(views) - 1)])
        small = np.asarray(view.resize((side, side), Image.Resampling.NEAREST))
        frame[-side - _FRAME :, -side - _FRAME :] = 255
        frame[-side:, -side:] = small
