r"""Records demonstrations of the best of some trained experts.

    python -m jaxil.collect --workdirs=runs/expert0,runs/expert1 \
        --output=jaxil/demonstrations/cartpole_swingup.npz --num_episodes=50

Each run's policy is evaluated by its mean action; the best one plays the episodes.
The file holds simulator states, not pixels: whoever trains renders them as their agent
sees.
"""

import pathlib
import sys

from absl import flags

from jaxil import command

_NUM_EVAL_EPISODES = 10
# The recording environment's seed: shared by no training and no evaluation.
_SEED = 777


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(argv, __doc__ or "", _define)
    missing = [
        f"--{n} is missing" for n in ("workdirs", "output") if not values[n].value
    ]
    if missing:
        raise command.UsageError(command.listing(missing))
    from jaxil import platform

    print(platform.prepare(), file=sys.stderr, flush=True)
    import numpy as np

    from jaxil import recording, trained
    from jaxil.host import demonstrations
    from jaxil.host.evaluation import evaluate

    runs = [trained.load(pathlib.Path(folder)) for folder in values.workdirs]
    tasks = sorted({run.config.task for run in runs})
    if len(tasks) > 1:
        raise command.UsageError(
            f"--workdirs hold runs of different tasks ({', '.join(tasks)}); give the "
            "seeds of one task"
        )
    means = []
    for folder, run in zip(values.workdirs, runs, strict=True):
        evaluation = evaluate(
            run.environment, run.act, num_episodes=_NUM_EVAL_EPISODES, first_episode=0
        )
        means.append(evaluation.mean)
        print(f"{folder}: mean {evaluation.mean:.1f}, std {evaluation.std:.1f}")
    best = int(np.argmax(means))
    states = recording.record(runs[best], num_episodes=values.num_episodes, seed=_SEED)
    try:
        demonstrations.write_states(values.output, states)
    except (OSError, demonstrations.DemonstrationError) as error:
        raise command.UsageError(f"--output={values.output}: {error}") from error
    returns = states.rewards.sum(axis=1)
    size = pathlib.Path(values.output).stat().st_size / 1e6
    print(
        f"{values.output}: {len(returns)} episodes of {values.workdirs[best]}, return "
        f"mean {returns.mean():.1f}, minimum {returns.min():.1f}, maximum "
        f"{returns.max():.1f}, {size:.2f} MB"
    )


def _define(values: flags.FlagValues) -> None:
    flags.DEFINE_list(
        "workdirs",
        [],
        "folders of runs of one task, comma-separated",
        flag_values=values,
    )
    flags.DEFINE_string("output", None, "file to write, NAME.npz", flag_values=values)
    flags.DEFINE_integer(
        "num_episodes",
        50,
        "episodes to record",
        lower_bound=1,
        upper_bound=10_000,
        flag_values=values,
    )


if __name__ == "__main__":
    command.run(main)
