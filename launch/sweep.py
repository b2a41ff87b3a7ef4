"""Trains many runs: `jaxil sweep`, for a checkout that is not installed."""

import pathlib
import sys

# The project's root in place of this folder, as for `python -m`.
sys.path[0] = str(pathlib.Path(__file__).resolve().parent.parent)

from jaxil import command, sweep  # noqa: E402

if __name__ == "__main__":
    command.run(sweep.main)
