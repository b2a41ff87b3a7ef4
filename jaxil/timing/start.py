"""How long `jaxil.launch` takes from the command to the agent's first step.

    python -m jaxil.timing.start CONFIG_FILE.py WORKDIR

starts a run and ends it at that step; `seconds_to_first_step` calls that.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any

from jaxil.config import Config

_PATIENCE_SECONDS = 600.0  # on two busy cores it takes 20 s


def seconds_to_first_step(
    config: Config, environment: Mapping[str, str], say: Callable[[str], None]
) -> float | None:
    """Starts a run in a process of its own.

    What was compiled or drawn on this machine before lies in the caches, as for any
    run but the first.

    Args:
      config: checked.
      environment: variables that the user has set.
      say: takes a line on why it was not measured.

    Returns:
      Seconds, None if the process failed.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "config.py").write_text(_config_file(config))
        words = ["-m", "jaxil.timing.start", str(folder / "config.py"), str(folder)]
        begin = time.monotonic()
        try:
            finished = subprocess.run(
                [sys.executable, *words],
                check=True,
                # The calling process may have taken most of the accelerator's memory.
                env={**environment, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=_PATIENCE_SECONDS,
            )
            return json.loads(finished.stdout.splitlines()[-1]) - begin
        except subprocess.CalledProcessError as error:
            reason = next(iter(error.stderr.strip().splitlines()[-1:]), "no message")
        except subprocess.TimeoutExpired:
            reason = f"it took longer than {_PATIENCE_SECONDS:.0f} s"
    say(f"start not measured: {reason}")
    return None


def main(config_file: str, workdir: str) -> None:
    """Runs `jaxil.launch` up to the agent's first step.

    Prints `time.monotonic()` of that moment, a clock that all processes share, and ends
    this one at once.
    """
    from jaxil.machine import startup

    startup.prepare()
    from jaxil import command, launch
    from jaxil.environments import suite

    def step(self: suite.PixelEnvironment, action: Any) -> Any:
        print(json.dumps(time.monotonic()), flush=True)
        os._exit(0)

    suite.PixelEnvironment.step = step
    sys.argv = ["launch", f"--config={config_file}", f"--workdir={workdir}/run"]
    command.run(launch.main)


def _config_file(config: Config) -> str:
    """Returns a config file with every setting in force."""
    text = json.dumps(config.to_dict())
    return (
        "import json\n\nimport ml_collections\n\n\n"
        "def get_config():\n"
        f"    return ml_collections.ConfigDict(json.loads({text!r}))\n"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
