r"""Records demonstrations of acrobot_swingup by a controller that plans.

    python launch/experts/acrobot.py --output=acrobot_swingup.npz --num_episodes=50

No learning: a swing-up law with eight gains, and a linear-quadratic regulator near the
top. No gains serve all starts, so each episode draws thousands, predicts the return of
each with the equations of motion, takes the best, and looks again every second of
simulated time until the arm stands. One core needs some six seconds per episode.
"""

import sys
import time
from typing import Any

import numpy as np
import studio
from acrobot_model import Arm
from acrobot_planner import Effort, control, search

from jaxil.machine import startup

TASK = "acrobot_swingup"
_SEARCH_EVERY_STEPS = 50
_STANDS = 0.9  # predicted share of the greatest return from which nothing is searched
FIRST = Effort(draws=24_000, variations=3000, rounds=3, exact=120)
LATER = Effort(draws=4000, variations=1500, rounds=1, exact=60)


def record(num_episodes: int, *, first: Effort = FIRST, later: Effort = LATER) -> Any:
    """Plays episodes and returns them as `StateDemonstrations`.

    Each episode's draws depend on its number alone. Progress goes to stderr.

    Args:
      num_episodes: K.
      first: effort of the search at an episode's start.
      later: effort of the searches after it.
    """
    began_cpu = time.process_time()
    environment = studio.make_environment(TASK)
    arm = Arm(environment.physics)
    arrays = studio.play(
        environment,
        lambda episode: _controller(environment, arm, episode, first, later),
        num_episodes,
    )
    environment.close()
    return studio.demonstrations(
        TASK,
        arrays,
        "planning with the simulator's equations, no learning: energy swing-up "
        "and linear-quadratic regulator, eight gains searched for each episode "
        f"(at its start {first.draws} drawn, {first.variations} varied in each "
        f"of {first.rounds} rounds; then every {_SEARCH_EVERY_STEPS} decisions "
        f"until it stands {later.draws}, {later.variations}, {later.rounds}); "
        f"{(time.process_time() - began_cpu) / 60:.1f} minutes of one core; no "
        "noise",
    )


def _controller(
    environment: Any, arm: Arm, episode: int, first: Effort, later: Effort
) -> studio.Decide:
    rng = np.random.default_rng([studio.SEED, episode])
    gains, stands = np.zeros(0), False

    def decide(step: int) -> np.ndarray:
        nonlocal gains, stands
        now = environment.simulator_state()
        state = np.concatenate([now["qpos"], now["qvel"]])
        if step % _SEARCH_EVERY_STEPS == 0 and not stands:
            left = environment.episode_steps - step
            held, effort = (gains, later) if step else (None, first)
            gains, coming = search(arm, state, held, left, effort, rng)
            stands = coming > _STANDS * studio.ACTION_REPEAT * left
        return control(arm, tuple(state[:, None]), gains[:, None])

    return decide


def main(argv: list[str]) -> None:
    """Runs the command."""
    parser = studio.Parser(__doc__)
    values = parser.parse_args(argv)
    print(startup.prepare(), file=sys.stderr, flush=True)
    studio.write(parser, values.output, lambda: record(values.num_episodes))


if __name__ == "__main__":
    main(sys.argv[1:])
