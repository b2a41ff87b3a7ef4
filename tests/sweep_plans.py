"""Plans of small sweeps, and what is refused of them."""

import pytest

from jaxil.errors import UsageError
from jaxil.sweeps import plan


def make_runs(folder, config_problems=lambda config: [], **changes):
    settings = {
        "methods": ["pdac", "psil"],
        "ablations": [],
        "tasks": ["cartpole_swingup", "walker_run"],
        "num_seeds": 2,
        "preset": "paper",
        "folder": folder,
        "overrides": {},
        **changes,
    }
    return plan.make_runs(plan.Request(**settings), config_problems)


def config_of(run):
    return plan.command.read_config(
        word for word in run.command if word.startswith("--config")
    )


def faults_of(folder, *arguments, **changes):
    with pytest.raises(UsageError) as raised:
        make_runs(folder, *arguments, **changes)
    return [str(fault) for fault in raised.value.faults]
