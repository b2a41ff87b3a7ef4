r"""Records demonstrations of acrobot_swingup by planning, without learning.

    python launch/experts/acrobot.py --output=acrobot_swingup.npz --num_episodes=50

A swing-up law with eight gains, and a linear-quadratic regulator near the top. No gains
work from all initial states, so each episode samples thousands, predicts their returns
with the equations of motion and uses the best; it repeats the search every second of
simulated time until the arm stands. An episode takes about six seconds of one core.
"""

from typing import Any, NamedTuple

import numpy as np
import studio
from acrobot_model import Arm, task_reward

_SEARCH_EVERY_STEPS = 50
_STANDS = 0.9  # share of the highest possible return, predicted, that ends the search
_ELITE = 10  # gains that are varied in each round
_VARIATION = 0.2  # relative standard deviation
# Range of each gain; positive ones are sampled log-uniformly.
GAINS = {
    "pump": (0.5, 4.0),  # torque per missing joule
    "pump_speed": (0.2, 5.0),  # seconds: how soon the elbow's speed saturates
    "bend": (-2.5, 2.5),  # radians: how the elbow follows the shoulder's speed
    "bend_speed": (0.1, 2.0),  # seconds
    "sway": (-1.2, 1.2),  # radians: how the elbow follows the shoulder's angle
    "stiffness": (0.3, 3.0),  # torque per radian
    "catch_angle": (0.3, 1.0),  # radians within which the regulator may take over
    "catch_torque": (2.5, 30.0),  # most it may then ask for, relative to the maximum
}


class Effort(NamedTuple):
    """The size of one search."""

    draws: int  # new gains, in the first round
    variations: int  # of the best gains so far, in each round
    rounds: int  # at least 1
    exact: int  # gains per round whose return is predicted exactly


FIRST = Effort(draws=24_000, variations=3000, rounds=3, exact=120)
LATER = Effort(draws=4000, variations=1500, rounds=1, exact=60)


def record(num_episodes: int, *, first: Effort = FIRST, later: Effort = LATER) -> Any:
    """Returns `StateDemonstrations`, by searches at an episode's start and later."""

    def prepare(environment: Any) -> Any:
        arm = Arm(environment.physics)
        return lambda episode: _controller(environment, arm, episode, first, later)

    return studio.record(
        "acrobot_swingup",
        prepare,
        num_episodes,
        "planning with the simulator's equations, no learning: energy swing-up "
        "and linear-quadratic regulator, eight gains searched for each episode "
        f"(at its start {first.draws} sampled, {first.variations} varied in each "
        f"of {first.rounds} rounds; then every {_SEARCH_EVERY_STEPS} decisions "
        f"until it stands {later.draws}, {later.variations}, {later.rounds})",
    )


def _controller(
    environment: Any, arm: Arm, episode: int, first: Effort, later: Effort
) -> Any:
    rng = np.random.default_rng([studio.SEED, episode])
    gains, stands = np.zeros(0), False

    def decide(step: int, observation: np.ndarray) -> np.ndarray:
        nonlocal gains, stands
        del observation  # lacks the angles themselves
        now = environment.simulator_state()
        state = np.concatenate([now["qpos"], now["qvel"]])
        if step % _SEARCH_EVERY_STEPS == 0 and not stands:
            left = environment.episode_steps - step
            held, effort = (gains, later) if step else (None, first)
            gains, coming = search(arm, state, held, left, effort, rng)
            stands = coming > _STANDS * studio.ACTION_REPEAT * left
        return control(arm, tuple(state[:, None]), gains[:, None])

    return decide


def control(arm: Arm, state: tuple, gains: np.ndarray) -> np.ndarray:
    """Returns actions [N] in [-1, 1] for gains [8, N] in the order of `GAINS`.

    Far from the top, torque adds the missing energy, and bends the elbow to follow the
    shoulder's motion; near the top the regulator takes over.

    Source: Spong 1995, "The swing up control problem for the acrobot", for energy and
    arctangent; sway and catch limits are our additions.
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
    """Returns the return [N] of gains [8, N] from one state [4].

    With `exact` as in the environment; else four times as fast, in float32 with one
    time step per agent step.
    """
    dtype = np.float64 if exact else np.float32
    gains = gains.astype(dtype)
    states = tuple(np.full(gains.shape[1], value, dtype) for value in state)
    total = np.zeros(gains.shape[1], dtype)
    frames = 1 if exact else studio.ACTION_REPEAT
    for _ in range(num_steps):
        action = control(arm, states, gains).astype(np.float32).astype(dtype)
        for _ in range(studio.ACTION_REPEAT // frames):
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
    """Returns the best gains [8] and their predicted return.

    They are at least as good as the gains in use, `held`, [8].
    """
    best = np.zeros((len(GAINS), 0)) if held is None else held[:, None]
    returns = np.zeros(0)
    for number in range(effort.rounds):
        tried = _sample(0 if number else effort.draws, rng)
        if best.size:
            parents = best[:, rng.integers(best.shape[1], size=effort.variations)]
            varied = parents * np.exp(_VARIATION * rng.normal(size=parents.shape))
            tried = np.append(tried, varied, axis=1)
        # The motion is chaotic, so the fast prediction only preselects.
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


if __name__ == "__main__":
    studio.run(studio.Parser(__doc__), lambda values: record(values.num_episodes))
