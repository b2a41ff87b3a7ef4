"""Plans actions in the simulator, guided by a learned policy and its values."""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import rollout
from studio import ACTION_REPEAT

_FULL_SPEED = 10.0  # m/s, at which the reward reaches 1 per frame
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS

# Observations [B, S] -> actions [B, A] and the values [B] of taking them.
Judge = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Effort(NamedTuple):
    """The size of the search for one decision."""

    horizon: int = 10  # H, simulated agent steps
    candidates: int = 64  # N, sequences of H actions in each round
    rounds: int = 12
    spread: float = 0.4  # standard deviation in the first round
    elites: int = 8  # best sequences, around which the next round samples
    temperature: float = 0.1  # of their weights, in units of return


class Simulator:
    """Simulates from any state without changing the environment."""

    def __init__(self, physics: Any) -> None:
        """Takes the model of a dm_control `Physics`."""
        self._model, self._live = physics.model.ptr, physics.data.ptr
        self._data = mujoco.MjData(self._model)
        sensor = self._model.sensor("torso_subtreelinvel")
        self._speed = int(sensor.adr[0])
        self._positions = slice(2, 1 + self._model.nq)  # all but time and the x axis
        start = 1 + self._model.nq
        self._velocities = slice(start, start + self._model.nv)

    def now(self) -> np.ndarray:
        """Returns the environment's current state, shape [P]."""
        state = np.empty(mujoco.mj_stateSize(self._model, _STATE))
        mujoco.mj_getState(self._model, self._live, state, _STATE)
        return state

    def run(
        self, state: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulates sequences of actions [N, H, A] in [-1, 1] from one state [P].

        Returns:
          States [N, H, P] and rewards [N, H] after each agent step. Rewards are of the
          speed one frame before the task's.
        """
        count, horizon, _ = actions.shape
        controls = np.repeat(actions, ACTION_REPEAT, axis=1).astype(np.float64)
        starts = np.tile(state, (count, 1))
        states, sensors = rollout.rollout(self._model, self._data, starts, controls)
        paid = np.clip(sensors[:, :, self._speed] / _FULL_SPEED, 0.0, 1.0)
        rewards = paid.reshape(count, horizon, ACTION_REPEAT).sum(axis=2)
        return states[:, ACTION_REPEAT - 1 :: ACTION_REPEAT], rewards

    def observe(self, states: np.ndarray) -> np.ndarray:
        """Returns the suite's observations float32 [..., S] of states [..., P]."""
        parts = states[..., self._positions], states[..., self._velocities]
        return np.concatenate(parts, axis=-1).astype(np.float32)


class Planner(NamedTuple):
    """Improves on a policy by simulating sequences of actions."""

    simulator: Simulator
    judge: Judge
    discount: float
    effort: Effort

    def follow(self, state: np.ndarray) -> np.ndarray:
        """Returns the policy's next actions, shape [H, A]."""
        actions = []
        for _ in range(self.effort.horizon):
            action = self.judge(self.simulator.observe(state)[None])[0]
            state = self.simulator.run(state, action[None])[0][0, -1]
            actions.append(action[0])
        return np.stack(actions)

    def score(self, state: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Returns the predicted return [N] of sequences of actions [N, H, A].

        sum_{t<H} gamma^t r_t + gamma^H min_k Q_k(s_H, pi(s_H))
        """
        states, rewards = self.simulator.run(state, actions)
        gamma, horizon = self.discount, actions.shape[1]
        values = self.judge(self.simulator.observe(states[:, -1]))[1]
        return rewards @ gamma ** np.arange(horizon) + gamma**horizon * values

    def search(
        self, state: np.ndarray, plan: np.ndarray | None, rng: np.random.Generator
    ) -> np.ndarray:
        """Returns a sequence of actions [H, A] at least as good as the policy's.

        The cross-entropy method with MPPI's weights: each round samples around the
        weighted mean of the last; the policy's sequence is always a candidate. `plan`
        is the last decision's result; None at an episode's start.
        """
        effort = self.effort
        usual = self.follow(state)
        mean = usual if plan is None else np.concatenate([plan[1:], usual[-1:]])
        spread = np.full(mean.shape, effort.spread)
        for _ in range(effort.rounds):
            noise = rng.standard_normal((effort.candidates, *mean.shape))
            candidates = mean + spread * noise
            few = effort.candidates // 4
            candidates[:few] = usual + effort.spread * noise[:few]
            candidates[0], candidates[1] = usual, mean
            candidates = np.clip(candidates, -1.0, 1.0)
            scores = self.score(state, candidates)
            best = np.argsort(-scores)[: effort.elites]
            weights = np.exp((scores[best] - scores[best[0]]) / effort.temperature)
            weights = (weights / weights.sum())[:, None, None]
            mean = np.sum(weights * candidates[best], axis=0)
            variance = np.sum(weights * np.square(candidates[best] - mean), axis=0)
            spread = np.clip(np.sqrt(variance), 0.05, effort.spread)
        return mean
