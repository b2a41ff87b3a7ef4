r"""Trains one agent: imitation from video, or DrQ-v2 on the true reward.

    jaxil train --config=pdac:walker_walk --workdir=runs/pdac
    jaxil train --config=psil:cheetah_run --workdir=runs/psil --config.seed=3

Rerun the same command to resume. `python -m jaxil.launch` is the same command.
"""

import os

from absl import flags

from jaxil import command
from jaxil.errors import RunFailed, UsageError


def main(argv: list[str]) -> int:
    """Runs the command; returns its exit status."""
    from jaxil.machine import screen, startup
    from jaxil.training import workdir

    values = command.parse(argv, __doc__ or "", _define, workdir.output_problems)
    folder = workdir.from_flag(values.workdir)
    # Before jax and MuJoCo are imported, which the imports below do.
    screen.say(startup.prepare())

    from jaxil import doctor, train
    from jaxil.machine import devices, provenance
    from jaxil.training import agent as agents
    from jaxil.training import assembly

    config = values.config
    was_new = not os.path.exists(folder / "config.json")
    faults = [*workdir.problems(folder, config), *assembly.problems(config)]
    if faults:
        raise UsageError(faults)
    devices.device_name()  # refuses a wrong JAX_PLATFORMS before anything is written
    for finding in doctor.memory(config):
        screen.say(str(finding))
    gl_name = assembly.renderer_name(config, films=config.video_every_evals > 0)
    native = agents.uses_native_convolutions(config)
    description = provenance.describe(gl_name, native=native)
    with workdir.opened(folder):
        # Another process may have begun and ended a run there in the meantime.
        if was_new and (faults := workdir.problems(folder, config)):
            raise UsageError(faults)
        try:
            workdir.write_config(folder, config, description)
            finished = train.train(config, folder)
        except (RunFailed, workdir.RunFolderError) as error:
            screen.say(f"training stopped: {error}")
            return 1
    return 0 if finished else 130


def _define(values: flags.FlagValues) -> None:
    command.define_config(values)
    flags.DEFINE_string(
        "workdir", None, "folder of the run; made if missing", flag_values=values
    )


if __name__ == "__main__":
    command.run(main)
