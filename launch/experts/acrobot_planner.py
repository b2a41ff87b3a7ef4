"""Searches the gains of a swing-up law for the highest predicted return."""

from typing import NamedTuple

import numpy as np
from acrobot_model import Arm, task_reward
from studio import ACTION_REPEAT

_ELITE = 10  # gains that are varied in each round
_VARIATION = 0.2  # relative, standard deviation
# Smallest and largest of each gain; those of one sign are sampled log-uniformly.
GAINS = {
    "pump": (0.5, 4.0),  # torque per joule that is missing
    "pump_speed": (0.2, 5.0),  # seconds: how soon the elbow's speed counts as full
    "bend": (-2.5, 2.5),  # radians: how the elbow follows the shoulder's speed
    "bend_speed": (0.1, 2.0),  # seconds
    "sway": (-1.2, 1.2),  # radians: how the elbow follows the shoulder's angle
    "stiffness": (0.3, 3.0),  # torque per radian
    "catch_angle": (0.3, 1.0),  # radians: where the regulator may take over, ...
    "catch_torque": (2.5, 30.0),  # ... asking at most for this many times the greatest
}


class Effort(NamedTuple):
    """How much one search tries."""

    draws: int  # new gains, in the first round
    variations: int  # of the best gains so far, in each round
    rounds: int  # at least 1
    exact: int  # the best of a round by a quick prediction, which are predicted again


def control(arm: Arm, state: tuple, gains: np.ndarray) -> np.ndarray:
    """Returns actions [N] in [-1, 1], by gains [8, N] in the order of `GAINS`.

    Far from the top the elbow's torque adds the missing energy, and bends the elbow
    after the shoulder's movement; near it the regulator takes over.

    Source: Spong 1995, "The swing up control problem for the acrobot", for the energy
    and the arctangent; sway and the limits of the catch are ours.
    """
    pump, pump_speed, bend, bend_speed, sway, stiffness, angle, torque = gains
    turn = 2 * float(np.pi)
    q1, q2 = (q - turn * np.round(q / turn) for q in state[:2])
    v1, v2 = state[2:]
    missing = arm.greatest_energy - arm.energy(state)
    target = bend * np.arctan(bend_speed * v1) + sway * np.sin(q1)
    swing = pump * missing * np.tanh(pump_speed * v2) + stiffness * (target - q2)
    k1, k2, k3, k4 = (float(value) for value in arm.regulator)
    balance = -(k1 * q1 + k2 * q2 + k3 * v1 + k4 * v2)
    near = (np.abs(q1) + 0.5 * np.abs(q2) < angle) & (np.abs(balance) < torque)
    near &= np.abs(v2) < 4.0
    return np.clip(np.where(near, balance, swing), -1, 1)


def predict(
    arm: Arm, state: np.ndarray, gains: np.ndarray, num_steps: int, *, exact: bool
) -> np.ndarray:
    """Returns the return [N] of each column of gains [8, N] from one state [4].

    Args:
      arm: the model.
      state: where all start.
      gains: see `control`.
      num_steps: agent steps that are left.
      exact: as the environment would, with actions rounded to float32; else in float32
        with one time step per agent step, four times as fast.
    """
    dtype = np.float64 if exact else np.float32
    gains = gains.astype(dtype)
    states = tuple(np.full(gains.shape[1], value, dtype) for value in state)
    total = np.zeros(gains.shape[1], dtype)
    frames = 1 if exact else ACTION_REPEAT
    for _ in range(num_steps):
        action = control(arm, states, gains).astype(np.float32).astype(dtype)
        for _ in range(ACTION_REPEAT // frames):
            states = arm.step(states, action, frames)
            total += frames * task_reward(*states[:2])
    return total


def search(
    arm: Arm,
    state: np.ndarray,
    held: np.ndarray | None,
    num_steps: int,
    effort: Effort,
    rng: np.random.Generator,
) -> tuple[np.ndarray, float]:
    """Returns the best gains found, [8], and their predicted return.

    `held` are gains in use, which only better ones replace, [8]; others as `predict`.
    """
    best = np.zeros((len(GAINS), 0)) if held is None else held[:, None]
    returns = np.zeros(0)
    for number in range(effort.rounds):
        tried = _sample(0 if number else effort.draws, rng)
        if best.size:
            parents = best[:, rng.integers(best.shape[1], size=effort.variations)]
            varied = parents * np.exp(_VARIATION * rng.normal(size=parents.shape))
            tried = np.append(tried, varied, axis=1)
        # The motion magnifies rounding, so the quick prediction only sorts out.
        rough = predict(arm, state, tried, num_steps, exact=False)
        best = np.append(best, tried[:, np.argsort(-rough)[: effort.exact]], axis=1)
        returns = predict(arm, state, best, num_steps, exact=True)
        order = np.argsort(-returns, kind="stable")[:_ELITE]
        best, returns = best[:, order], returns[order]
    return best[:, 0], float(returns[0])


def _sample(number: int, rng: np.random.Generator) -> np.ndarray:
    rows = [
        rng.uniform(low, high, number)
        if low < 0
        else np.exp(rng.uniform(np.log(low), np.log(high), number))
        for low, high in GAINS.values()
    ]
    return np.stack(rows)
