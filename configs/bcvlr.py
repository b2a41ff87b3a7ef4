r"""BCV-LR on the paper's backbone, on any task.

python -m jaxil.launch --config=configs/bcvlr.py:cheetah_run --workdir=runs/bcvlr
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the settings for `task`."""
    return jaxil_config.default_config("bcvlr", task)
