"""The learner's updates: their batches drawn, collected, brought to the device, run."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.learner.gathering import Frames
from jaxil.learner.state import TrainState
from jaxil.maths.types import Batch, ExpertBatch, ExpertEpisodes, Metrics, Window
from jaxil.replay.device_copy import DeviceCopy
from jaxil.replay.replay import Replay
from jaxil.training import assembly
from jaxil.training.assembly import Agent

Drawn = tuple[Batch | None, ExpertBatch | None]

_REFRESH_EPISODES = 8  # in one call; bounds what leaves the host's memory at once


class Updates:
    """Draws a batch for each update that is due, and runs so many at once.

    With `replay_on_device`, frames lie on the device and batches name their places;
    without, batches are stacked on the host and sent whole. Both draw the same ones.
    """

    def __init__(
        self,
        config: Config,
        agent: Agent,
        replay: Replay,
        demonstrations: loading.Demonstrations | None,
        experts: ExpertEpisodes | None,
    ) -> None:
        """Copies the frames to the device, where they shall lie there.

        Args:
          config: checked.
          agent: the compiled steps.
          replay: filled already, on a resume.
          demonstrations: what the method imitates, or None.
          experts: the same on the device, for methods that match whole episodes.
        """
        self._config = config
        self._agent = agent
        self._replay = replay
        self._demonstrations = demonstrations
        self._experts = experts
        self._pending: list[Drawn] = []
        self._clones = config.method == "bc"
        self._mirror: DeviceCopy | None = None
        self._expert_frames: jax.Array | None = None
        if config.replay_on_device:
            if not self._clones:
                self._mirror = DeviceCopy(replay)
            if experts is not None:
                self._expert_frames = experts.frames  # no second copy
            elif demonstrations is not None and self._samples_expert:
                self._expert_frames = jnp.asarray(demonstrations.frames)

    @property
    def _samples_expert(self) -> bool:
        return self._clones or self._agent.rewarder.samples_expert

    def collect(self, rng: np.random.Generator) -> bool:
        """Draws for one update; says whether there are enough to be run.

        Until they are run, no episode may enter the replay.
        """
        self._pending.append(self.draw(rng))
        return len(self._pending) >= self._config.updates_per_dispatch

    def run(self, state: TrainState) -> tuple[TrainState, Metrics | None]:
        """Runs what is collected.

        Args:
          state: donated.

        Returns:
          The state after it, and metrics of the last update, None without any.
        """
        pending, self._pending = self._pending, []
        frames, metrics = self.frames(), None
        if len(pending) > 1 and len(pending) == self._config.updates_per_dispatch:
            batches = jax.tree.map(lambda *leaves: np.stack(leaves), *pending)
            return self._agent.repeated_step(state, *batches, frames)
        # Fewer, because an episode or a budget ended: a scan of another length would
        # have to be compiled.
        for batch, expert in pending:
            state, metrics = self._agent.update_step(state, batch, expert, frames)
        return state, metrics

    def episode_added(self) -> None:
        """Follows the replay, after an episode has entered it."""
        if self._mirror is not None:
            self._mirror.refresh()

    def refresh_rewards(self, state: TrainState) -> None:
        """Recomputes the rewards of all stored episodes with the rewarder as it is.

        Args:
          state: read; not donated.

        Raises:
          ValueError: a reward is not finite.
        """
        replay = self._replay
        by_length: dict[int, list[int]] = {}
        for index in replay.episodes:
            by_length.setdefault(len(replay.slots(index)), []).append(index)
        for indices in by_length.values():
            for first in range(0, len(indices), _REFRESH_EPISODES):
                chunk = indices[first : first + _REFRESH_EPISODES]
                # Always of one size, so that it is compiled once for each length.
                padded = chunk + chunk[-1:] * (_REFRESH_EPISODES - len(chunk))
                rewards = self._refreshed(state, padded)[: len(chunk)]
                for index, new in zip(chunk, rewards, strict=True):
                    replay.replace_rewards(index, new)

    def _refreshed(self, state: TrainState, indices: list[int]) -> np.ndarray:
        slots = np.stack([self._replay.slots(index) for index in indices])
        actions = np.stack([self._replay.actions(index) for index in indices])
        if self._mirror is not None:
            frames = self._mirror.frames
        else:
            frames = self._replay.frames[slots.ravel()]
            slots = np.arange(slots.size).reshape(slots.shape)
        rewards = self._agent.refresh(
            state.rewarder,
            state.params,
            frames,
            slots.astype(np.int32),
            actions,
            self._experts,
        )
        return np.asarray(rewards)

    def frames(self) -> Frames | None:
        """Returns the frames that lie on the device; None where none do.

        An episode that enters the replay replaces them.
        """
        if not self._config.replay_on_device:
            return None
        agent = None if self._mirror is None else self._mirror.frames
        return Frames(agent, self._expert_frames)

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Draws what one update learns from."""
        config = self._config
        batch = expert = None
        if not self._clones:
            on_host = self._mirror is None
            draw = self._replay.sample if on_host else self._replay.sample_indices
            windows = self._agent.rewarder.relabel is not None
            drawn = draw(rng, config.batch_size, windows=windows)
            window = None if drawn.window is None else Window(*drawn.window)
            batch = Batch(*drawn[:-1], window=window)
        if self._samples_expert:
            expert = self._draw_expert(rng)
        return batch, expert

    def _draw_expert(self, rng: np.random.Generator) -> ExpertBatch:
        assert self._demonstrations is not None
        on_host = self._expert_frames is None
        draw = loading.sample if on_host else loading.sample_indices
        group = self._config.cloning if self._clones else self._config.discriminator
        drawn = draw(
            self._demonstrations,
            rng,
            group.batch_size,
            frame_stack=assembly.stack_size(self._config),
        )
        return ExpertBatch(*drawn)
