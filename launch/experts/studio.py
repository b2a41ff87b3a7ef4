"""What the experts share: flags, recording, and the output file."""

import argparse
import pathlib
import sys
import time
from collections.abc import Callable
from typing import Any, NoReturn

from jaxil.command import UsageError
from jaxil.demonstrations import playing, states
from jaxil.environments import tasks
from jaxil.files.writing import obstacle
from jaxil.machine import startup

SEED = 777  # as in `jaxil.collect`
ACTION_REPEAT = 2
_MAX_EPISODES = 10_000

# Environment -> episode number, the only source of randomness -> controller.
Prepare = Callable[[Any], Callable[[int], playing.Decide]]


def record(
    task: str, prepare: Prepare, num_episodes: int, expert: str
) -> states.StateDemonstrations:
    """Records episodes. `expert` describes how they are made."""
    began, began_cpu = time.monotonic(), time.process_time()

    def finished(episode: int, task_return: float) -> None:
        print(
            f"episode {episode + 1} of {num_episodes}: return {task_return:.1f}, "
            f"{(time.monotonic() - began) / 60:.1f} minutes",
            file=sys.stderr,
            flush=True,
        )

    with tasks.make_environment(
        task, seed=SEED, action_repeat=ACTION_REPEAT, observation="state"
    ) as environment:
        begin = prepare(environment)
        arrays = playing.play(environment, begin, num_episodes, finished)
    minutes = (time.process_time() - began_cpu) / 60
    metadata = states.new_metadata(
        task=task,
        action_repeat=ACTION_REPEAT,
        seed=SEED,
        expert=f"{expert}; {minutes:.1f} minutes of one core; no noise",
        rewards=arrays["rewards"],
    )
    return states.StateDemonstrations(**arrays, metadata=metadata)


class Parser(argparse.ArgumentParser):
    """The flags that all experts have."""

    def __init__(self, description: str | None) -> None:
        form = argparse.RawDescriptionHelpFormatter
        super().__init__(description=description, formatter_class=form)
        self.add_argument(
            "--output", type=_file, required=True, help="file to write, NAME.npz"
        )
        self.add_argument(
            "--num_episodes", type=_count, default=50, help="episodes to record (50)"
        )

    def error(self, message: str) -> NoReturn:
        """Exits with one sentence, without printing the usage."""
        self.exit(2, f"{message}; --help lists the flags\n")


def run(parser: Parser, make: Callable[[Any], states.StateDemonstrations]) -> None:
    """Runs an expert's command; `make` records, given the values of the flags."""
    values = parser.parse_args()
    print(startup.prepare(), file=sys.stderr, flush=True)
    try:
        recorded = make(values)
        states.write_states(values.output, recorded)
    except KeyboardInterrupt:
        sys.exit(130)
    except UsageError as error:
        parser.error(str(error))
    except OSError as error:
        parser.error(f"argument --output: {values.output}: {error}")
    returns = recorded.rewards.sum(axis=1)
    print(
        f"{values.output}: {len(returns)} episodes, return mean {returns.mean():.1f}, "
        f"minimum {returns.min():.1f}, maximum {returns.max():.1f}"
    )


def _file(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{path} is a folder: name a file, NAME.npz")
    if why := obstacle(path.parent):  # before minutes of work are lost
        raise argparse.ArgumentTypeError(f"{path} cannot be written ({why})")
    return path


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= _MAX_EPISODES:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a number from 1 to {_MAX_EPISODES}"
        )
    return int(text)
