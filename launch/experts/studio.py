"""What the controllers share: flags, playing, and the file that comes of it."""

import argparse
import pathlib
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

SEED = 777  # the resets', as in `jaxil.collect`
ACTION_REPEAT = 2
_MOST_EPISODES = 10_000

Decide = Callable[[int], np.ndarray]  # number of the decision -> action [A]


def make_environment(task: str) -> Any:
    """Returns the environment that plays and is recorded."""
    from jaxil.environments import suite

    return suite.make_environment(
        task, seed=SEED, action_repeat=ACTION_REPEAT, observation="state"
    )


def play(environment: Any, begin: Callable[[int], Decide], num_episodes: int) -> Any:
    """Plays episodes and returns what `StateDemonstrations` holds, but its metadata.

    Progress goes to stderr.

    Args:
      environment: of `make_environment`.
      begin: episode -> the controller for it, after its reset. Its draws may depend on
        the episode's number alone.
      num_episodes: K.

    Returns:
      `qpos`, `qvel`, `act`, `actions` and `rewards`, each [K, ...].
    """
    began = time.monotonic()
    episodes: list[dict[str, list]] = []
    for episode in range(num_episodes):
        environment.reset(episode=episode)
        decide = begin(episode)
        played: dict[str, list] = {
            name: [value] for name, value in environment.simulator_state().items()
        }
        played |= {"actions": [], "rewards": []}
        for step in range(environment.episode_steps):
            action = np.asarray(decide(step), np.float32)
            timestep = environment.step(action)
            for name, value in environment.simulator_state().items():
                played[name].append(value)
            played["actions"].append(action)
            played["rewards"].append(timestep.reward)
        episodes.append(played)
        minutes = (time.monotonic() - began) / 60
        print(
            f"episode {episode + 1} of {num_episodes}: return "
            f"{sum(played['rewards']):.1f}, {minutes:.1f} minutes",
            file=sys.stderr,
            flush=True,
        )
    arrays = {
        name: np.stack([np.asarray(played[name]) for played in episodes])
        for name in episodes[0]
    }
    return arrays | {"rewards": arrays["rewards"].astype(np.float32)}


def demonstrations(task: str, arrays: Any, expert: str) -> Any:
    """Returns `StateDemonstrations` of what `play` returned.

    Args:
      task: `domain_task`.
      arrays: of `play`.
      expert: how the episodes were made.
    """
    from jaxil.demonstrations import states

    metadata = states.new_metadata(
        task=task,
        action_repeat=ACTION_REPEAT,
        seed=SEED,
        first_episode=0,
        expert=expert,
        rewards=arrays["rewards"],
    )
    return states.StateDemonstrations(**arrays, metadata=metadata)


class Parser(argparse.ArgumentParser):
    """Flags of a controller: --output and --num_episodes, and what it adds."""

    def __init__(self, description: str | None) -> None:
        super().__init__(
            description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.add_argument(
            "--output", type=_file, required=True, help="file to write, NAME.npz"
        )
        self.add_argument(
            "--num_episodes", type=_count, default=50, help="episodes to record (50)"
        )

    def error(self, message: str) -> NoReturn:
        """Ends the command with one sentence instead of the usage."""
        self.exit(2, f"{message}; --help lists the flags\n")


def write(parser: Parser, output: pathlib.Path, record: Callable[[], Any]) -> None:
    """Records and writes, or ends the command; says what came of it.

    Args:
      parser: ends the command where the file can't be written.
      output: the file.
      record: returns the demonstrations.
    """
    from jaxil.demonstrations import states

    try:
        recorded = record()
    except KeyboardInterrupt:
        sys.exit(130)
    try:
        states.write_states(output, recorded)
    except OSError as error:
        parser.error(f"argument --output: {output}: {error}")
    returns = recorded.rewards.sum(axis=1)
    print(
        f"{output}: {len(returns)} episodes, return mean {returns.mean():.1f}, "
        f"minimum {returns.min():.1f}, maximum {returns.max():.1f}"
    )


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
