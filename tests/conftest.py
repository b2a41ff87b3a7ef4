"""Strictness for all tests: no silent broadcasting, and one way of drawing."""

import os
import signal

# Before jax and MuJoCo are imported anywhere: flags and GL are read only once.
from jaxil.machine import startup

os.environ.setdefault("JAX_PLATFORMS", "cpu")
startup.prepare()

# A shell that starts the tests in the background has them ignore Ctrl-C, nohup has them
# ignore hang-ups, and so would all programs whose signals are tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

import jax  # noqa: E402

# [B] against [B, 1] is the classic silent error of reinforcement learning.
jax.config.update("jax_numpy_rank_promotion", "raise")
