"""How the tests start the project's commands, at sizes that take seconds."""

import contextlib
import importlib
import io
import os
import pathlib
import subprocess
import sys
from unittest import mock

from jaxil import command
from tests.processes import ROOT

# Ten frames per agent step make an episode of 100 steps.
SMALL = (
    "--config.action_repeat=10",
    "--config.image_size=24",
    "--config.encoder.channels=(32,32)",
    "--config.encoder.kernel_sizes=(4,3)",
    "--config.encoder.strides=(4,1)",
    "--config.hidden_dim=16",
    "--config.feature_dim=8",
    "--config.batch_size=8",
    "--config.demonstrations.num_episodes=2",
    "--config.replay_size_steps=1000",
    "--config.exploration_steps=50",
    "--config.seed_frames=1000",
    "--config.update_every_steps=10",
    "--config.num_eval_episodes=1",
    "--config.eval_every_frames=2000",
    "--config.checkpoint_every_frames=2000",
    "--config.total_frames=4000",
)
# Nothing is rendered, and there are no convolutions to compile.
STATES = ("--config.observation=state", "--config.encoder.subtract_mean_image=False")

# Fields of single methods, in small.
_DISCRIMINATOR = ("discriminator.hidden_dim=16", "discriminator.batch_size=8")
_SINKHORN = ("sinkhorn.target_update_steps=150", "sinkhorn.num_iterations=10")
_CLONING = ("cloning.num_pairs=8", "inverse_model.head_dim=16")
_OWN = {
    **dict.fromkeys(("pdac", "dac", "laifo", "gaifo"), _DISCRIMINATOR),
    "patchail": ("discriminator.width=2", "discriminator.batch_size=8"),
    "psil": _SINKHORN,
    "sil": ("discriminator.batch_size=8", "sinkhorn.num_iterations=10"),
    "bc": ("cloning.batch_size=8",),
    "bco": ("cloning.batch_size=8", "inverse_model.hidden_dim=16"),
    "bcvlr": ("cloning.batch_size=8", "latent.hidden_dim=16"),
    "pdac_cloning": (*_DISCRIMINATOR, *_CLONING),
    "psil_cloning": (*_SINKHORN, *_CLONING),
}


def call(module: str, *flags: str) -> subprocess.CompletedProcess:
    """Does what `run` does, but in this process, which saves the seconds of a start."""
    main = importlib.import_module(f"jaxil.{module}").main
    words = [f"jaxil.{module}", *flags]
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(ROOT),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", words),
    ):
        try:
            command.run(main)
        except SystemExit as ended:
            status = int(ended.code or 0)
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


def arguments(module: str, *flags: str) -> list[str]:
    """Returns the command line of `python -m jaxil.MODULE FLAGS`."""
    return [sys.executable, "-m", f"jaxil.{module}", *flags]


def run(module: str, *flags: str, timeout: float = 900.0):
    """Runs a command to its end; returns it with status and output."""
    return subprocess.run(
        arguments(module, *flags),
        check=False,
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=timeout,
    )


def small(method: str) -> tuple[str, ...]:
    """Returns the flags that make a method small."""
    return (*SMALL, *(f"--config.{word}" for word in _OWN.get(method, ())))


def small_run(method: str, workdir: pathlib.Path) -> tuple[str, ...]:
    """Returns the flags of a run of seconds."""
    return (
        f"--config=configs/tiny.py:{method},ball_in_cup_catch",
        f"--workdir={workdir}",
        *small(method),
    )
