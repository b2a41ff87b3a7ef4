r"""Evaluates the newest checkpoint of a run: returns, and a video.

    jaxil evaluate --workdir=runs/pdac --num_episodes=50

The policy takes its mean action. The run is not changed. A video, WORKDIR/videos/
evaluation_FRAME.mp4, shows the first episode beside the expert's; --gif adds a GIF.
"""

import pathlib
import sys
from typing import Any

from absl import flags

from jaxil import command
from jaxil.errors import UsageError

_FIRST_EPISODE = 1_000_000  # training evaluates on none of these starts


def main(argv: list[str]) -> None:
    """Runs the command."""
    from jaxil.machine import startup
    from jaxil.training import workdir

    values = command.parse(argv, __doc__ or "", _define, workdir.run_problems)
    folder = workdir.from_flag(values.workdir)

    print(startup.prepare(), file=sys.stderr, flush=True)
    from jaxil.training import trained

    policy, environment = trained.load(folder)
    with environment:
        _evaluate(values, folder, policy, environment)


def _evaluate(
    values: flags.FlagValues, folder: pathlib.Path, policy: Any, environment: Any
) -> None:
    """Prints the returns of a policy, and films its first episode."""
    from jaxil import config as jaxil_config
    from jaxil.demonstrations.states import DemonstrationError
    from jaxil.environments.evaluation import evaluate
    from jaxil.machine import screen
    from jaxil.training import assembly, film

    config = policy.config
    films = assembly.renderer_name(config, films=False) != "none"
    if not films:
        screen.say("no video is written: nothing renders here, see jaxil doctor")
    evaluation = evaluate(
        environment,
        policy,
        num_episodes=values.num_episodes,
        first_episode=_FIRST_EPISODE,
        record=film.recorder(environment, values.video_size) if films else None,
    )
    for number, task_return in enumerate(evaluation.task_returns):
        print(f"episode {number}: {task_return:.1f}")
    returns = evaluation.task_returns
    line = (
        f"{config.method} on {config.task}, frame {policy.frame}: mean "
        f"{evaluation.mean:.1f}, std {evaluation.std:.1f}, minimum {returns.min():.1f},"
        f" maximum {returns.max():.1f}"
    )
    if jaxil_config.uses_demonstrations(config):
        try:
            expert_return = assembly.expert_return(config)
            if expert_return is not None:
                line += f"; the expert's mean {expert_return:.1f}"
        except DemonstrationError as error:
            if not films:  # else the video says it
                screen.say(f"without demonstrations: {error}")
    print(line)
    if films:
        sides = film.sides(
            config,
            environment,
            evaluation,
            first_episode=_FIRST_EPISODE,
            image_size=values.video_size,
            shows_progress=True,
        )
        videos = folder / "videos"
        try:
            videos.mkdir(exist_ok=True)
            kinds = {"video": "mp4", "gif": "gif"} if values.gif else {"video": "mp4"}
            for kind, suffix in kinds.items():
                path = videos / f"evaluation_{policy.frame:09d}.{suffix}"
                film.write(path, sides)
                print(f"{kind}: {path}")
        except OSError as error:
            raise UsageError(
                f"{videos} cannot be written ({error.strerror or error}); make room or"
                " make it writable, or evaluate a copy of the run"
            ) from error


def _define(values: flags.FlagValues) -> None:
    flags.DEFINE_string("workdir", None, "folder of the run", flag_values=values)
    command.define_trust(values)
    flags.DEFINE_integer(
        "num_episodes", 10, "episodes to play", 1, 100_000, flag_values=values
    )
    flags.DEFINE_integer(
        "video_size", 256, "pixels of a side of the video", 16, 1024, flag_values=values
    )
    flags.DEFINE_boolean("gif", False, "also writes a GIF", flag_values=values)


if __name__ == "__main__":
    command.run(main)
