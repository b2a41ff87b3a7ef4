"""A task as the agent sees it: agent steps, stacked images or states."""

import logging
import math
import numbers
from typing import Any

import dm_env
import numpy as np
from dm_env import specs
from PIL import Image

from jaxil.environments import observations
from jaxil.errors import raised
from jaxil.replay.stacking import gather_stacks

_UNBOUNDED = 1e9  # MuJoCo's value for an actuator without limits
_USUAL_FRAMES = 1000  # of an episode in dm_control

_logger = logging.getLogger(__name__)


class PixelEnvironment(dm_env.Environment):
    """Any dm_env environment in agent steps, with stacked images or states.

    One agent step is `action_repeat` environment frames. An observation is the last
    `frame_stack` images, uint8 [H, W, 3 * frame_stack], oldest first; at a reset the
    first image is repeated. With `observation="state"` it is the task's own
    observation without images, flattened, float32 [S], and nothing is rendered unless
    requested.

    The image is the task's observation, if that is or holds one RGB image, else what
    its `render()` returns, scaled if it has another size. Tasks may also offer
    `seed(number)`, called before each reset, `step_limit` (frames of a whole episode)
    and `frame_seconds`.
    """

    def __init__(
        self,
        simulator: Any,
        *,
        seed: int,
        action_repeat: int,
        image_size: int,
        frame_stack: int,
        observation: str,
        max_episode_frames: int = 0,
    ):
        """Wraps a dm_env.Environment; arguments as for `tasks.make_environment`.

        Raises ValueError if its actions or observations cannot be used.
        """
        self._simulator, self._seed = simulator, seed
        self._action_repeat = action_repeat
        self.image_size = image_size
        self._renders = observation == "pixels"
        limit = self.step_limit or math.inf
        if not max_episode_frames and math.isinf(limit):
            max_episode_frames = _USUAL_FRAMES
        self._frame_limit = min(limit, max_episode_frames or limit)
        self._frames_played = 0
        self._next_episode = 0
        self._reset_next_step = True
        self._seen: Any = None  # the task's own newest observation
        self._image_shape: tuple[int, ...] = ()  # of the images in it, once seen
        self._current: np.ndarray | None = None  # newest frame, once rendered
        self._frames: list[np.ndarray] = []  # of the observation
        self._frame_stack = frame_stack
        bounds = simulator.action_spec()
        self._action_low, self._action_high = _action_range(bounds)
        self._action_dtype = bounds.dtype
        self._action_spec = specs.BoundedArray(
            bounds.shape, np.float32, minimum=-1.0, maximum=1.0, name="action"
        )
        if self._renders:
            shape = (image_size, image_size, 3 * frame_stack)
            self._observation_spec: specs.Array = specs.BoundedArray(
                shape, np.uint8, minimum=0, maximum=255, name="observation"
            )
        else:
            parts = observations.states_in(simulator.observation_spec())
            state_dim = sum(math.prod(part.shape) for part in parts)
            if state_dim == 0:
                raise ValueError("observes images alone: set observation to 'pixels'.")
            self._observation_spec = specs.Array(
                (state_dim,), np.float32, name="observation"
            )

    def reset(self, episode: int | None = None) -> dm_env.TimeStep:
        """Starts an episode, by default the next one.

        Its number and the seed determine the initial state.
        """
        if episode is None:
            episode = self._next_episode
        if episode < 0:
            raise ValueError(f"episode={episode} must not be negative.")
        seeds = np.random.SeedSequence([self._seed, episode])
        begun = _timestep("reset", self._restart(seeds.generate_state(8)))
        self._seen = begun.observation
        self._next_episode = episode + 1
        self._reset_next_step, self._frames_played = False, 0
        self._current, self._frames = None, []
        return dm_env.restart(self._observe())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Applies an action [A] in [-1, 1], or resets if the episode is over.

        Over the action repeat rewards are summed and discounts multiplied; a time
        limit leaves the discount at 1.
        """
        if self._reset_next_step:
            return self.reset()
        action = np.asarray(action, dtype=np.float64)
        expected = self._action_spec.shape
        if action.shape != expected:
            raise ValueError(f"action has shape {action.shape}, expected {expected}.")
        half_range = (self._action_high - self._action_low) / 2.0
        control = self._action_low + (action + 1.0) * half_range
        # Rounded, an action of 1 may lie above the bound.
        control = np.clip(control, self._action_low, self._action_high)
        if np.issubdtype(self._action_dtype, np.integer):
            control = np.round(control)
        control = control.astype(self._action_dtype)
        reward, discount, is_last = 0.0, 1.0, False
        for _ in range(self._action_repeat):
            inner = _timestep("step", self._simulator.step(control.copy()))
            self._seen = inner.observation
            reward += _reward(inner.reward)
            discount *= _discount(inner.discount)
            self._frames_played += 1
            is_last = inner.last() or self._frames_played >= self._frame_limit
            if is_last:
                break
        self._reset_next_step, self._current = is_last, None
        kind = dm_env.StepType.LAST if is_last else dm_env.StepType.MID
        return dm_env.TimeStep(kind, reward, discount, self._observe())

    def action_spec(self) -> specs.BoundedArray:  # pyright: ignore
        """Returns the spec of actions: float32 [A] in [-1, 1]."""
        return self._action_spec

    def observation_spec(self) -> specs.Array:  # pyright: ignore
        """Returns the spec of stacked pixels, or of the state vector."""
        return self._observation_spec

    def single_observation(self) -> np.ndarray:
        """Returns the current frame: uint8 [H, W, 3], or float32 [S] in state mode."""
        if self._current is None:
            self._current = self.render() if self._renders else self._state()
        return self._current.copy()

    def frame(self) -> np.ndarray:
        """Returns the current image, uint8 [H, W, 3], also in state mode."""
        return self.single_observation() if self._renders else self.render()

    def render(self, image_size: int | None = None) -> np.ndarray:
        """Returns a new image, uint8 [H, W, 3], of the given size or the agent's."""
        side = image_size or self.image_size
        image, size = self._observed_image(), (side, side)
        if image is None:
            image = self._rendered(side)
        if image.shape[:2] == size:
            return np.array(image)
        # Pillow widens its filter where it shrinks an image, which prevents aliasing.
        resized = Image.fromarray(image).resize(size, Image.Resampling.BILINEAR)
        return np.array(resized)

    @property
    def own_image_size(self) -> int | None:
        """After a reset: side of the square image that the task observes, or None."""
        shapes = [image.shape[:2] for image in observations.images_in(self._seen)]
        is_square = len(shapes) == 1 and shapes[0][0] == shapes[0][1]
        return shapes[0][0] if is_square else None

    def renderer_name(self) -> str:
        """Returns a few words on what renders the images."""
        return "the task's own"

    @property
    def step_limit(self) -> float | None:
        """Frames of a whole episode; None or infinity without a time limit."""
        return self._own_number("step_limit")

    @property
    def episode_steps(self) -> int:
        """Agent steps of a whole episode; longer ones are cut off."""
        return math.ceil(self._frame_limit / self._action_repeat)

    @property
    def step_seconds(self) -> float | None:
        """Simulated duration of an agent step; None if unknown."""
        seconds = self._own_number("frame_seconds")
        return None if seconds is None else seconds * self._action_repeat

    def close(self) -> None:
        """Frees the simulation; an error of the task's own `close` is only logged."""
        try:
            self._simulator.close()
        except Exception as error:  # whatever the user's task raises
            _logger.warning("the task raised an error in close(): %s", raised(error))

    def _own_number(self, name: str) -> float | None:
        """Returns a number that the task may offer, None without it."""
        found = getattr(self._simulator, name, None)
        if found is None:
            return None
        if not isinstance(found, numbers.Real) or not float(found) > 0.0:
            raise ValueError(f"has {name}={found!r}; make it a number above 0, or None")
        return float(found)

    def _restart(self, seeds: np.ndarray) -> dm_env.TimeStep:
        """Starts the episode that `seeds`, uint32 [8], determine."""
        if hasattr(self._simulator, "seed"):
            self._simulator.seed(int(seeds[0]))
        return self._simulator.reset()

    def _observed_image(self) -> np.ndarray | None:
        """Returns the image that the task itself observes; None unless it is one."""
        images = observations.images_in(self._seen)
        if len(images) != 1:
            return None
        shape, expected = images[0].shape, self._image_shape or images[0].shape
        if shape != expected:
            raise ValueError(f"observes {shape} images, but at first {expected}")
        self._image_shape = shape
        return images[0]

    def _rendered(self, side: int) -> np.ndarray:
        render = getattr(self._simulator, "render", None)
        if render is None:
            raise ValueError(
                f"neither observes one uint8 [H, W, 3] nor offers render(); it "
                f"observes {observations.described(self._seen)}"
            )
        scales = getattr(self._simulator, "renders_any_size", False)
        image = np.asarray(render(side) if scales else render())
        if not observations.is_image(image):
            what = f"renders {observations.described(image)}"
            raise ValueError(f"{what}, but uint8 [H, W, 3] is expected")
        return image

    def _state(self) -> np.ndarray:
        state = observations.flat_state(self._seen)
        (size,) = self._observation_spec.shape
        if len(state) != size:
            raise ValueError(f"observes {len(state)} numbers, but its spec says {size}")
        return state

    def _observe(self) -> np.ndarray:
        single = self.single_observation()
        if not self._renders:
            return single
        self._frames = [*(self._frames or [single] * self._frame_stack), single]
        self._frames = self._frames[-self._frame_stack :]
        indices = np.arange(self._frame_stack)[None]
        return gather_stacks(np.stack(self._frames), indices)[0]


def _action_range(bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns the smallest and largest actions; -1 and 1 where there are no limits."""
    is_bounded = isinstance(bounds, specs.BoundedArray)
    if not is_bounded or not len(bounds.shape) == 1 <= bounds.shape[0]:
        raise ValueError(f"has actions {bounds}, but needs a bounded vector")
    low, high = (
        np.broadcast_to(x, bounds.shape).astype(np.float64)
        for x in (bounds.minimum, bounds.maximum)
    )
    if np.isnan(low).any() or np.isnan(high).any():
        raise ValueError(f"has NaN among the limits of its actions: {bounds}")
    below, above = np.abs(low) < _UNBOUNDED, np.abs(high) < _UNBOUNDED
    if np.any(below != above):
        raise ValueError(f"has actions with one limit alone: {bounds}; give both")
    return np.where(below, low, -1.0), np.where(below, high, 1.0)


def _timestep(function: str, value: Any) -> Any:
    """Returns what `reset` or `step` returned, if it is like dm_env's; else raises."""
    parts = ("observation", "reward", "discount", "last")
    if all(hasattr(value, part) for part in parts):
        return value
    what = f"{function}() returned {type(value).__name__}"
    raise ValueError(f"{what}; it must return a dm_env.TimeStep")


def _reward(value: Any) -> float:
    """Returns a task's reward, which may be NaN, but not None as at a reset."""
    try:
        return float(value)
    except (TypeError, ValueError):
        rule = "must be a number, 0 in a task without rewards"
        raise ValueError(f"a step's reward is {value!r}; it {rule}") from None


def _discount(value: Any) -> float:
    """Returns a task's discount, which must lie in [0, 1]."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0.0 <= number <= 1.0:
        rule = "must lie in [0, 1], with 0 at a true end"
        raise ValueError(f"a step's discount is {value!r}; it {rule}")
    return number
