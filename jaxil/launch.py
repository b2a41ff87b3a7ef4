r"""Trains one agent: imitation from video, or DrQ-v2 on the true reward.

    python -m jaxil.launch --config=configs/pdac_walker.py --workdir=runs/pdac
    python -m jaxil.launch --config=configs/psil.py:cheetah_run --workdir=runs/psil \
        --config.seed=3

The same command again goes on where the run stopped.
"""

import pathlib
import sys

from absl import flags

from jaxil import command
from jaxil.errors import UsageError


def main(argv: list[str]) -> int:
    """Runs the command; returns its exit status."""
    values = command.parse(argv, __doc__ or "", _define)
    if values.workdir is None:
        raise UsageError(
            "--workdir is missing: name a folder for the run, such as --workdir=runs/1"
        )
    # Before jax and MuJoCo are imported, which the imports below do.
    from jaxil.machine import startup

    print(startup.prepare(), file=sys.stderr, flush=True)

    from jaxil import doctor, train
    from jaxil.environments.pool import EnvironmentsFailed
    from jaxil.machine import provenance
    from jaxil.training import agent as agents
    from jaxil.training import assembly, workdir

    config = values.config
    folder = pathlib.Path(values.workdir)
    faults = assembly.problems(config) + workdir.problems(folder, config)
    if faults:
        raise UsageError(faults)
    for finding in doctor.memory(config):
        print(finding, file=sys.stderr, flush=True)
    with workdir.opened(folder):
        try:
            gl_name = assembly.renderer_name(config)
            native = agents.uses_native_convolutions(config)
            description = provenance.describe(gl_name, native=native)
            workdir.write_config(folder, config, description)
            finished = train.train(config, folder)
        except (train.TrainingDiverged, EnvironmentsFailed) as error:
            print(f"training stopped: {error}", file=sys.stderr)
            return 1
    return 0 if finished else 130


def _define(values: flags.FlagValues) -> None:
    command.define_config(values)
    flags.DEFINE_string(
        "workdir", None, "folder of the run; made if missing", flag_values=values
    )


if __name__ == "__main__":
    command.run(main)
