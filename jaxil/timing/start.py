"""Times the start of a run: to its first step, and compiling its update."""

import json
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from jaxil import methods
from jaxil.config import Config
from jaxil.machine import screen

_TIMEOUT_SECONDS = 600.0  # it takes 20 s on two busy cores
# A run that prints the system's monotonic clock at its first step and exits.
_RUN = """
import json, os, sys, time
from jaxil.machine import startup
startup.prepare()
from jaxil import command, launch
from jaxil.environments.pixel_environment import PixelEnvironment

def step(self, action):
    print(json.dumps(time.monotonic()), flush=True)
    os._exit(0)

PixelEnvironment.step = step
command.run(launch.main)
"""
_CONFIG_FILE = """
import json, ml_collections

def get_config():
    return ml_collections.ConfigDict(json.loads({!r}))
"""


def first_step_seconds(config: Config, environment: Mapping[str, str]) -> float | None:
    """Returns the time from the command to the first step, with warm caches.

    `environment` are the user's variables. If the run fails, says so and returns None.
    """
    settings = config.to_dict()
    settings["num_environments"] = 1  # so that this process steps it
    if not methods.get(config.method).plays:  # only its evaluation does
        settings["total_frames"] = config.update_every_steps * config.action_repeat
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder, "config.py")
        file.write_text(_CONFIG_FILE.format(json.dumps(settings)))
        words = ["-c", _RUN, f"--config={file}", f"--workdir={folder}/run"]
        begin = time.monotonic()
        try:
            finished = subprocess.run(
                [sys.executable, *words],
                check=True,
                # This process may hold most of the accelerator's memory.
                env={**environment, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_SECONDS,
            )
            return json.loads(finished.stdout.splitlines()[-1]) - begin
        except subprocess.CalledProcessError as error:
            reason = next(iter(error.stderr.strip().splitlines()[-1:]), "no message")
        except subprocess.TimeoutExpired:
            reason = f"it took longer than {_TIMEOUT_SECONDS:.0f} s"
    screen.say(f"start not measured: {reason}")
    return None


def compile_seconds(lower: Callable[[], Any]) -> float:
    """Returns the time to trace and compile a program without caches.

    Clears the compiled programs of this process, so call it last.
    """
    jax.clear_caches()
    before = jax.config.values["jax_enable_compilation_cache"]
    try:
        jax.config.update("jax_enable_compilation_cache", False)
        compilation_cache.reset_cache()  # jax reads the setting only once
        begin = time.perf_counter()
        lower().compile()
        return time.perf_counter() - begin
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        compilation_cache.reset_cache()
