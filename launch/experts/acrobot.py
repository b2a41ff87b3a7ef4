r"""Records demonstrations of acrobot_swingup by a controller that plans.

    python launch/experts/acrobot.py --output=acrobot_swingup.npz --num_episodes=50

No learning: a swing-up law with eight gains, and a linear-quadratic regulator near the
top. No gains serve all starts, so each episode draws thousands, predicts the return of
each with the equations of motion, takes the best, and looks again every second of
simulated time until the arm stands. One core needs some six seconds per episode.
"""

import argparse
import pathlib
import sys
import tempfile
import time
from typing import Any, NoReturn

import numpy as np
from acrobot_model import ACTION_REPEAT, Arm
from acrobot_planner import Effort, control, search

from jaxil import platform

TASK = "acrobot_swingup"
_MOST_EPISODES = 10_000
_SEED = 777  # the resets', as in `jaxil.collect`
_SEARCH_EVERY_STEPS = 50
_STANDS = 0.9  # predicted share of the greatest return from which nothing is searched
FIRST = Effort(draws=24_000, variations=3000, rounds=3, exact=120)
LATER = Effort(draws=4000, variations=1500, rounds=1, exact=60)


def record(num_episodes: int, *, first: Effort = FIRST, later: Effort = LATER) -> Any:
    """Plays episodes and returns them as `jaxil.host.states.StateDemonstrations`.

    Each episode's draws depend on its number alone. Progress goes to stderr.

    Args:
      num_episodes: K.
      first: effort of the search at an episode's start.
      later: effort of the searches after it.
    """
    from jaxil.host import environment as environments
    from jaxil.host import states

    began, began_cpu = time.monotonic(), time.process_time()
    environment = environments.make_environment(
        TASK, seed=_SEED, action_repeat=ACTION_REPEAT, observation="state"
    )
    arm = Arm(environment.physics)
    episodes = []
    for episode in range(num_episodes):
        episodes.append(_play(environment, arm, episode, first, later))
        minutes = (time.monotonic() - began) / 60
        print(
            f"episode {episode + 1} of {num_episodes}: return "
            f"{sum(episodes[-1]['rewards']):.1f}, {minutes:.1f} minutes",
            file=sys.stderr,
            flush=True,
        )
    environment.close()
    arrays = {
        name: np.stack([np.asarray(played[name]) for played in episodes])
        for name in episodes[0]
    }
    rewards = arrays.pop("rewards").astype(np.float32)
    return states.StateDemonstrations(
        **arrays,
        rewards=rewards,
        metadata=states.new_metadata(
            task=TASK,
            action_repeat=ACTION_REPEAT,
            seed=_SEED,
            first_episode=0,
            expert=(
                "planning with the simulator's equations, no learning: energy swing-up "
                "and linear-quadratic regulator, eight gains searched for each episode "
                f"(at its start {first.draws} drawn, {first.variations} varied in each "
                f"of {first.rounds} rounds; then every {_SEARCH_EVERY_STEPS} decisions "
                f"until it stands {later.draws}, {later.variations}, {later.rounds}); "
                f"{(time.process_time() - began_cpu) / 60:.1f} minutes of one core; no "
                "noise"
            ),
            rewards=rewards,
        ),
    )


def _play(
    environment: Any, arm: Arm, episode: int, first: Effort, later: Effort
) -> dict[str, list]:
    rng = np.random.default_rng([_SEED, episode])
    environment.reset(episode=episode)
    played: dict[str, list] = {
        name: [value] for name, value in environment.simulator_state().items()
    }
    played |= {"actions": [], "rewards": []}
    gains, stands = np.zeros(0), False
    for step in range(environment.episode_steps):
        state = np.concatenate([played["qpos"][-1], played["qvel"][-1]])
        if step % _SEARCH_EVERY_STEPS == 0 and not stands:
            left = environment.episode_steps - step
            held, effort = (gains, later) if step else (None, first)
            gains, coming = search(arm, state, held, left, effort, rng)
            stands = coming > _STANDS * ACTION_REPEAT * left
        action = control(arm, tuple(state[:, None]), gains[:, None]).astype(np.float32)
        timestep = environment.step(action)
        for name, value in environment.simulator_state().items():
            played[name].append(value)
        played["actions"].append(action)
        played["rewards"].append(timestep.reward)
    return played


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Ends the command with one sentence instead of the usage."""
        self.exit(2, f"{message}; --help lists the flags\n")


def _file(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{path} is a folder: name a file, NAME.npz")
    try:
        # Minutes of work should not end at a folder that can't be written.
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise argparse.ArgumentTypeError(
            f"{path} can't be written ({error.strerror or error})"
        ) from error
    return path


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= _MOST_EPISODES:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a number from 1 to {_MOST_EPISODES}"
        )
    return int(text)


def main(argv: list[str]) -> None:
    """Runs the command."""
    parser = _Parser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--output", type=_file, required=True, help="file to write, NAME.npz"
    )
    parser.add_argument(
        "--num_episodes", type=_count, default=50, help="episodes to record (50)"
    )
    values = parser.parse_args(argv)
    print(platform.prepare(), file=sys.stderr, flush=True)
    from jaxil.host import states

    try:
        recorded = record(values.num_episodes)
    except KeyboardInterrupt:
        sys.exit(130)
    try:
        states.write_states(values.output, recorded)
    except OSError as error:
        parser.error(f"argument --output: {values.output}: {error}")
    returns = recorded.rewards.sum(axis=1)
    print(
        f"{values.output}: {len(returns)} episodes, return mean {returns.mean():.1f}, "
        f"minimum {returns.min():.1f}, maximum {returns.max():.1f}"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
