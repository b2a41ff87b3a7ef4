"""Films for people to watch: an episode of a policy beside the expert's."""

import contextlib
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from jaxil import config as jaxil_config
from jaxil.config import Config
from jaxil.demonstrations import rendering
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments import suite
from jaxil.environments.evaluation import Evaluation, Stopped
from jaxil.environments.pixel_environment import PixelEnvironment
from jaxil.errors import told_as
from jaxil.files import video
from jaxil.machine import progress, screen
from jaxil.training import assembly

SIZE = 256  # pixels of a side, unless another is asked for
_VIEW_SHARE = 0.3  # of a side, for the inset with what the agent sees
_BORDER = 1  # pixels around the inset
_GIF_FPS = 12.5


class Side(NamedTuple):
    """One of the two episodes."""

    frames: np.ndarray  # uint8 [T + 1, H, W, 3]
    captions: list[str]  # whose episode, time, return so far, newest reward


def recorder(environment: PixelEnvironment, image_size: int) -> Callable[[], Any]:
    """Returns the function that an evaluation calls at each moment of a filmed episode.

    It notes the simulator's state, which is rendered later in another simulator. A task
    without such states is rendered at once.
    """
    sees_pixels = len(environment.observation_spec().shape) == 3

    def record() -> tuple[np.ndarray | None, Any]:
        with told_as("the task", "an evaluation that is filmed"):
            view = environment.frame() if sees_pixels else None
            if isinstance(environment, suite.SuiteEnvironment):
                return view, environment.simulator_state()
            return view, environment.render(image_size)

    return record


def sides(
    config: Config,
    environment: PixelEnvironment,
    evaluation: Evaluation,
    *,
    first_episode: int,
    image_size: int = SIZE,
    imitation_rewards: np.ndarray | None = None,
    shows_progress: bool = False,
    stop_asked: Callable[[], bool] = lambda: False,
) -> list[Side]:
    """Returns the agent's episode and the expert's first one, if that is available.

    Args:
      config: of the run.
      environment: that of the evaluation.
      evaluation: recorded by `recorder` with the same size.
      first_episode: number of the recorded episode.
      image_size: height and width of the images.
      imitation_rewards: of the recorded episode, [T]; None if unknown.
      shows_progress: whether rendering shows a progress line.
      stop_asked: asked between images; rendering takes up to half a minute in software.

    Raises:
      Stopped: `stop_asked` said so.
    """
    views, moments = zip(*evaluation.recorded)
    seconds = environment.step_seconds
    if not isinstance(environment, suite.SuiteEnvironment):
        frames = np.stack(moments)
    else:
        with _shown("the agent's episode", shows_progress, stop_asked) as show:
            (frames,) = rendering.observe_episodes(
                {k: np.stack([m[k] for m in moments])[None] for k in moments[0]},
                task=config.task,
                seed=config.seed + assembly.EVALUATION_SEED,
                first_episode=first_episode,
                image_size=image_size,
                render_quality=config.render_quality,
                camera=config.camera,
                cache=False,
                progress=show,
            )
    if views[0] is not None:
        _inset(frames, views)
    rewards = evaluation.episodes[0].rewards
    captions = _captions("agent", len(frames), seconds, rewards, imitation_rewards)
    found = [Side(frames, captions)]
    if not jaxil_config.uses_demonstrations(config):
        return found
    try:
        with _shown("the expert's episode, once", shows_progress, stop_asked) as show:
            expert = assembly.load_shown_expert(config, image_size, show)
    except DemonstrationError as error:
        screen.say(f"the video is without the expert: {error}")
        return found
    frames = expert.frames[0, : expert.num_frames[0]]
    rewards = None if expert.task_rewards is None else expert.task_rewards[0]
    found.append(Side(frames, _captions("expert", len(frames), seconds, rewards)))
    return found


def write(path: pathlib.Path, beside: list[Side]) -> None:
    """Writes sides beside each other, as an mp4 or, at a lower rate, as a GIF.

    Both play at the rate of the first, the agent's, so they stay together: in ten
    seconds or less, where episodes of the suite last 10 to 25 simulated seconds.
    """
    fps = max(15.0, len(beside[0].frames) / 10.0)
    is_gif = path.suffix == ".gif"
    stride = round(fps / _GIF_FPS) if is_gif else 1
    frames = [side.frames[::stride] for side in beside]
    labels = [side.captions[::stride] for side in beside]
    write_images = video.write_gif if is_gif else video.write_video
    write_images(path, *frames, fps=fps / stride, labels=labels)


@contextlib.contextmanager
def _shown(
    what: str, shows_progress: bool, stop_asked: Callable[[], bool]
) -> Iterator[Callable[[int, int], None]]:
    """Yields a function (images done, all images) that raises Stopped if asked to."""
    line = progress.shown(f"rendering {what}") if shows_progress else None
    with line or contextlib.nullcontext() as show:

        def step(done: int, total: int) -> None:
            if stop_asked():
                raise Stopped
            if show is not None:
                show(done, total)

        yield step


def _captions(
    name: str,
    count: int,
    step_seconds: float | None,
    rewards: np.ndarray | None,
    imitation_rewards: np.ndarray | None = None,
) -> list[str]:
    texts = [name] * count
    if step_seconds is not None:
        texts = [f"{t}  {k * step_seconds:.1f} s" for k, t in enumerate(texts)]
    if rewards is not None:
        so_far = np.concatenate([[0.0], np.cumsum(rewards)])[:count]
        texts = [f"{t}  return {r:.0f}" for t, r in zip(texts, so_far)]
    if imitation_rewards is not None:
        newest = np.concatenate([[0.0], imitation_rewards])[:count]
        texts = [f"{t}  reward {r:.3g}" for t, r in zip(texts, newest)]
    return texts


def _inset(frames: np.ndarray, views: tuple[np.ndarray, ...]) -> None:
    """Puts what the agent sees into the lower right corner of each frame."""
    side = round(_VIEW_SHARE * frames.shape[1])
    for frame, view in zip(frames, views, strict=True):
        resized = Image.fromarray(view).resize((side, side), Image.Resampling.NEAREST)
        frame[-side - _BORDER :, -side - _BORDER :] = 255
        frame[-side:, -side:] = np.asarray(resized)
