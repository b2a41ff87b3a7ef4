"""Strictness for all tests: no silent broadcasting, and one way of drawing."""

import os

# Before jax and MuJoCo are imported anywhere: flags and GL are read only once.
from jaxil import platform

os.environ.setdefault("JAX_PLATFORMS", "cpu")
platform.prepare()

import jax  # noqa: E402

# [B] against [B, 1] is the classic silent error of reinforcement learning.
jax.config.update("jax_numpy_rank_promotion", "raise")
