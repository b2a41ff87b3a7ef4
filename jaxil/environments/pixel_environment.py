"""A suite task as the agent sees it: agent steps, stacked images or states."""

import math
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from jaxil.environments.camera import Renderer
from jaxil.replay.stacking import gather_stacks

_UNBOUNDED = 1e9  # MuJoCo's value for an actuator without limits


class PixelEnvironment(dm_env.Environment):
    """A suite task as an `interaction.Environment`.

    One agent step is `action_repeat` environment frames. An observation is the last
    `frame_stack` images, uint8 [H, W, 3 * frame_stack], oldest first; at a reset the
    first image is repeated. With `observation="state"` it is the suite's observation,
    flattened, float32 [S], and nothing is rendered unless requested.
    """

    def __init__(
        self,
        suite_environment: Any,
        *,
        task: str,
        seed: int,
        action_repeat: int,
        frame_stack: int,
        observation: str,
        renderer: Renderer,
    ):
        """Wraps `suite_environment`; arguments as for `make_environment`."""
        self._suite_environment = suite_environment
        self._name, self._seed = task, seed
        self._action_repeat = action_repeat
        self._renders = observation == "pixels"
        self.renderer = renderer
        self._next_episode = 0
        self._reset_next_step = True
        self._current: np.ndarray | None = None  # newest frame, once rendered
        self._frames: list[np.ndarray] = []  # of the observation
        self._frame_stack = frame_stack
        bounds = suite_environment.action_spec()
        bounded = np.abs(bounds.maximum) < _UNBOUNDED
        self._action_low = np.where(bounded, bounds.minimum, -1.0)
        self._action_half_range = (
            np.where(bounded, bounds.maximum, 1.0) - self._action_low
        ) / 2.0
        self._action_spec = specs.BoundedArray(
            shape=bounds.shape,
            dtype=np.float32,
            minimum=np.float32(-1.0),
            maximum=np.float32(1.0),
            name="action",
        )
        if self._renders:
            size = renderer.image_size
            self._observation_spec: specs.Array = specs.BoundedArray(
                shape=(size, size, 3 * frame_stack),
                dtype=np.uint8,
                minimum=0,
                maximum=255,
                name="observation",
            )
        else:
            parts = suite_environment.observation_spec().values()
            state_dim = sum(math.prod(part.shape) for part in parts)
            self._observation_spec = specs.Array(
                shape=(state_dim,), dtype=np.float32, name="observation"
            )

    def reset(self, episode: int | None = None) -> dm_env.TimeStep:
        """Starts an episode, whose number and the seed determine the initial state.

        Without a number it is the one after the last.
        """
        if episode is None:
            episode = self._next_episode
        if episode < 0:
            raise ValueError(f"episode={episode} must not be negative.")
        seeds = np.random.SeedSequence([self._seed, episode])
        self._suite_environment.task.random.seed(seeds.generate_state(8))
        self._suite_environment.reset()
        self._next_episode = episode + 1
        self._reset_next_step = False
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
        control = self._action_low + (action + 1.0) * self._action_half_range
        reward, discount, is_last = 0.0, 1.0, False
        for _ in range(self._action_repeat):
            inner = self._suite_environment.step(control)
            reward += float(inner.reward)
            discount *= float(inner.discount)
            is_last = inner.last()
            if is_last:
                break
        self._reset_next_step = is_last
        self._current = None
        kind = dm_env.StepType.LAST if is_last else dm_env.StepType.MID
        return dm_env.TimeStep(kind, reward, discount, self._observe())

    def action_spec(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> specs.BoundedArray:
        """Returns the spec of actions: float32 [A] in [-1, 1]."""
        return self._action_spec

    def observation_spec(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> specs.Array:
        """Returns the spec of stacked pixels, or of the state vector."""
        return self._observation_spec

    def single_observation(self) -> np.ndarray:
        """Returns the current frame: uint8 [H, W, 3], or float32 [S] in state mode."""
        if self._current is None:
            self._current = self.renderer.render() if self._renders else self._state()
        return self._current.copy()

    def frame(self) -> np.ndarray:
        """Returns the current image, uint8 [H, W, 3], also in state mode."""
        return self.single_observation() if self._renders else self.renderer.render()

    def simulator_state(self) -> dict[str, np.ndarray]:
        """Returns copies of `qpos`, `qvel` and `act`, each float64 and 1-D."""
        data = self.physics.data
        return {
            name: np.array(getattr(data, name), dtype=np.float64)
            for name in ("qpos", "qvel", "act")
        }

    def set_simulator_state(
        self, qpos: np.ndarray, qvel: np.ndarray, act: np.ndarray
    ) -> None:
        """Sets the simulation to a state from `simulator_state`.

        `frame` and `single_observation` show it at once, the stack after the next step.
        Touch and acceleration sensors, which depend on the previous step's forces, are
        computed without actuation.

        Raises:
          ValueError: an array does not have the model's shape.
        """
        data = self.physics.data
        values = {"qpos": qpos, "qvel": qvel, "act": act}
        for name, value in values.items():
            given, shape = np.shape(value), getattr(data, name).shape
            if given != shape:
                what = f"{name} has shape {given}"
                raise ValueError(f"{what}, but {self._name} needs {shape}.")
        with self.physics.reset_context():
            for name, value in values.items():
                getattr(data, name)[:] = value
        self._current = None

    @property
    def episode_steps(self) -> int | None:
        """Agent steps of a whole episode; None without a time limit."""
        limit = self._suite_environment._step_limit
        return None if math.isinf(limit) else math.ceil(limit / self._action_repeat)

    @property
    def physics(self) -> Any:
        """The dm_control `Physics`."""
        return self._suite_environment.physics

    def close(self) -> None:
        """Frees the simulation and its GL context."""
        self.physics.free()

    def _state(self) -> np.ndarray:
        values = self._suite_environment.task.get_observation(self.physics).values()
        flat = [np.ravel(value) for value in values]
        return np.concatenate(flat).astype(np.float32)

    def _observe(self) -> np.ndarray:
        single = self.single_observation()
        if not self._renders:
            return single
        self._frames = [*(self._frames or [single] * self._frame_stack), single]
        self._frames = self._frames[-self._frame_stack :]
        indices = np.arange(self._frame_stack)[None]
        return gather_stacks(np.stack(self._frames), indices)[0]
