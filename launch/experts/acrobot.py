r"""Records demonstrations of acrobot_swingup by a controller that plans.

    python launch/experts/acrobot.py --output=acrobot_swingup.npz --num_episodes=50

No learning: a swing-up law with eight gains, and a linear-quadratic regulator near the
top. No gains serve all starts, so each episode samples thousands, predicts the return
of each with the equations of motion, takes the best, and searches again every second of
simulated time until the arm stands. One core needs some six seconds per episode.
"""

from typing import Any

import numpy as np
import studio
from acrobot_model import Arm
from acrobot_planner import Effort, control, search

_SEARCH_EVERY_STEPS = 50
_STANDS = 0.9  # predicted share of the greatest return from which nothing is searched
FIRST = Effort(draws=24_000, variations=3000, rounds=3, exact=120)
LATER = Effort(draws=4000, variations=1500, rounds=1, exact=60)


def record(num_episodes: int, *, first: Effort = FIRST, later: Effort = LATER) -> Any:
    """Returns K episodes as `StateDemonstrations`.

    Args:
      num_episodes: K.
      first: effort of the search at an episode's start.
      later: effort of the searches after it.
    """

    def prepare(environment: Any) -> Any:
        arm = Arm(environment.physics)
        return lambda episode: _controller(environment, arm, episode, first, later)

    return studio.record(
        "acrobot_swingup",
        prepare,
        num_episodes,
        "planning with the simulator's equations, no learning: energy swing-up "
        "and linear-quadratic regulator, eight gains searched for each episode "
        f"(at its start {first.draws} drawn, {first.variations} varied in each "
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
        del observation  # the planner needs the angles themselves
        now = environment.simulator_state()
        state = np.concatenate([now["qpos"], now["qvel"]])
        if step % _SEARCH_EVERY_STEPS == 0 and not stands:
            left = environment.episode_steps - step
            held, effort = (gains, later) if step else (None, first)
            gains, coming = search(arm, state, held, left, effort, rng)
            stands = coming > _STANDS * studio.ACTION_REPEAT * left
        return control(arm, tuple(state[:, None]), gains[:, None])

    return decide


if __name__ == "__main__":
    studio.run(studio.Parser(__doc__), lambda values: record(values.num_episodes))
