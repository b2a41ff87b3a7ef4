r"""P-SIL at the paper's settings, on any task.

python -m jaxil.launch --config=configs/psil.py:cheetah_run --workdir=runs/psil
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the paper's settings for `task`."""
    return jaxil_config.default_config("psil", task)
