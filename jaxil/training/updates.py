"""Samples batches and runs the learner's updates, several in one call."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxil import methods
from jaxil.config import Config
from jaxil.demonstrations import loading, sampling
from jaxil.learner.gathering import Frames
from jaxil.learner.state import TrainState
from jaxil.maths.types import Batch, Data, ExpertBatch, ExpertEpisodes, Metrics
from jaxil.replay.device_copy import DeviceCopy
from jaxil.replay.replay import Replay
from jaxil.training.agent import Agent, stack_size
from jaxil.training.lengths import pad_rows

Sampled = tuple[Batch | None, ExpertBatch | None]

_REFRESH_EPISODES = 8  # in one call; bounds the memory on the device


class Updates:
    """Samples a batch for each update that is due, and runs several at once.

    With `replay_on_device`, frames are on the device and batches hold their indices.
    Otherwise batches are stacked on the host and sent whole. The samples are the same.
    """

    def __init__(
        self,
        config: Config,
        agent: Agent,
        replay: Replay,
        demonstrations: loading.Demonstrations | None,
        experts: ExpertEpisodes | None,
    ) -> None:
        """Takes the demonstrations and, for methods that match episodes, `experts`.

        With `replay_on_device` this copies the frames to the device, so the replay must
        be filled already when a run is resumed.
        """
        self._config, self._agent, self._replay = config, agent, replay
        self._demonstrations, self._experts = demonstrations, experts
        self._pending: list[Sampled] = []
        self._plays = methods.get(config.method).plays
        on_device = config.replay_on_device
        self._device_copy = DeviceCopy(replay) if on_device and self._plays else None
        self._expert_frames: Data | None = None
        if on_device and experts is not None:
            self._expert_frames = experts.frames  # no second copy
        elif on_device and demonstrations and agent.rewarder.expert_batch_size:
            self._expert_frames = jnp.asarray(demonstrations.frames)

    @property
    def is_pending(self) -> bool:
        """Whether collected updates have not run yet."""
        return bool(self._pending)

    def collect(self, rng: np.random.Generator) -> bool:
        """Samples for one update; returns whether a full group is pending.

        No episode may enter the replay until they have run.
        """
        self._pending.append(self.sample(rng))
        return len(self._pending) >= self._config.updates_per_dispatch

    def run(self, state: TrainState) -> tuple[TrainState, Metrics | None]:
        """Runs the collected updates on `state`, which is donated.

        Returns:
          The state after them, and the last one's metrics; None if there were none.
        """
        pending, self._pending = self._pending, []
        frames, metrics = self.frames(), None
        if len(pending) > 1 and len(pending) == self._config.updates_per_dispatch:
            batches = jax.tree.map(lambda *leaves: np.stack(leaves), *pending)
            return self._agent.repeated_step(state, *batches, frames)
        # One by one: a group of one, or one that the end of an episode or of the budget
        # cut short. A scan of another length would have to be compiled.
        for batch, expert in pending:
            state, metrics = self._agent.update_step(state, batch, expert, frames)
        return state, metrics

    def episode_added(self) -> None:
        """Updates the device copy after an episode has entered the replay."""
        if self._device_copy is not None:
            self._device_copy.refresh()

    def refresh_rewards(
        self, state: TrainState, require_finite: Callable[[dict[str, float]], None]
    ) -> None:
        """Recomputes the rewards of all stored episodes with the current rewarder.

        `require_finite` is called with rewards before they replace others.
        """
        replay = self._replay
        by_length: dict[int, list[int]] = {}
        for index in replay.episodes:
            length = self._agent.compiled_length(len(replay.slots(index)) - 1)
            by_length.setdefault(length, []).append(index)
        for length, indices in by_length.items():
            for first in range(0, len(indices), _REFRESH_EPISODES):
                chunk = indices[first : first + _REFRESH_EPISODES]
                # Always of one size, so that each length compiles once.
                filled = chunk + chunk[-1:] * (_REFRESH_EPISODES - len(chunk))
                rewards = self._refreshed(state, filled, length)[: len(chunk)]
                require_finite({"recomputed reward": float(np.sum(rewards))})
                for index, new in zip(chunk, rewards, strict=True):
                    replay.replace_rewards(index, new[: len(replay.slots(index)) - 1])

    def _refreshed(
        self, state: TrainState, indices: list[int], length: int
    ) -> np.ndarray:
        """Returns new rewards, [E, length], of episodes that are at most that long."""
        replay, copied = self._replay, self._device_copy
        slots = np.stack([pad_rows(replay.slots(i), length + 1) for i in indices])
        actions = np.stack([pad_rows(replay.actions(i), length) for i in indices])
        num_steps = np.array([len(replay.slots(i)) - 1 for i in indices], np.int32)
        if copied is None:
            frames = replay.frames[slots.ravel()]
            slots = np.arange(slots.size).reshape(slots.shape)
        else:
            frames = copied.frames
        rewards = self._agent.refresh(
            state.rewarder,
            state.params,
            frames,
            slots.astype(np.int32),
            actions,
            num_steps,
            self._experts,
        )
        return np.asarray(rewards)

    def frames(self) -> Frames | None:
        """Returns the frames that are on the device; None if none are.

        An episode that enters the replay replaces them.
        """
        if not self._config.replay_on_device:
            return None
        copied = self._device_copy
        return Frames(None if copied is None else copied.frames, self._expert_frames)

    def sample(self, rng: np.random.Generator) -> Sampled:
        """Samples what one update learns from."""
        rewarder, batch = self._agent.rewarder, None
        if self._plays:
            batch = self._replay.sample(
                rng,
                self._config.batch_size,
                windows=rewarder.relabel is not None,
                successors=rewarder.samples_successors,
                as_indices=self._device_copy is not None,
            )
        if not rewarder.expert_batch_size:
            return batch, None
        assert self._demonstrations is not None
        expert = sampling.sample(
            self._demonstrations,
            rng,
            rewarder.expert_batch_size,
            frame_stack=stack_size(self._config),
            successors=rewarder.samples_successors,
            as_indices=self._expert_frames is not None,
        )
        return batch, expert
