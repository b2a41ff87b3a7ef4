r"""Evaluates the newest checkpoint of a run: returns, and a video.

    jaxil evaluate --workdir=runs/pdac --num_episodes=50

The policy takes its mean action. The run is not changed; the video is written to
WORKDIR/videos/evaluation.mp4.
"""

import sys

from absl import flags

from jaxil import command

_FIRST_EPISODE = 1_000_000  # none that training evaluates on


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(argv, __doc__ or "", _define)
    from jaxil.machine import startup
    from jaxil.training import workdir

    folder = workdir.from_flag(values.workdir)

    print(startup.prepare(), file=sys.stderr, flush=True)
    from jaxil.environments.evaluation import evaluate
    from jaxil.files.video import write_video
    from jaxil.training import assembly, run_log, trained

    run = trained.load(folder)
    gl_name = assembly.renderer_name(run.config)
    evaluation = evaluate(
        run.environment,
        run.act,
        num_episodes=values.num_episodes,
        first_episode=_FIRST_EPISODE,
        record_video=gl_name != "none",
    )
    for number, task_return in enumerate(evaluation.task_returns):
        print(f"episode {number}: {task_return:.1f}")
    returns = evaluation.task_returns
    line = (
        f"{run.config.method} on {run.config.task}, frame {run.act.frame}: mean "
        f"{evaluation.mean:.1f}, std {evaluation.std:.1f}, minimum {returns.min():.1f},"
        f" maximum {returns.max():.1f}"
    )
    expert_frames = None
    if run.demonstrations is not None:
        expert_return = run.demonstrations.mean_return()
        if expert_return is not None:
            line += f"; the expert's mean {expert_return:.1f}"
        if run.demonstrations.frames.ndim == 5:
            expert_frames = run.demonstrations.frames[0]
    print(line)
    if evaluation.video is None:
        return
    path = folder / "videos" / "evaluation.mp4"
    path.parent.mkdir(exist_ok=True)
    fps = run_log.frames_per_second(len(evaluation.video))
    write_video(path, evaluation.video, expert_frames, fps=fps)
    print(f"video: {path}")


def _define(values: flags.FlagValues) -> None:
    flags.DEFINE_string("workdir", None, "folder of the run", flag_values=values)
    command.define_trust(values)
    flags.DEFINE_integer(
        "num_episodes", 10, "episodes to play", 1, 100_000, flag_values=values
    )


if __name__ == "__main__":
    command.run(main)
