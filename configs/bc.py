r"""Behavioural cloning, a baseline, at the paper's settings, on any task.

python -m jaxil.launch --config=configs/bc.py:cheetah_run --workdir=runs/bc
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the paper's settings of behavioural cloning for `task`."""
    return jaxil_config.default_config("bc", task)
