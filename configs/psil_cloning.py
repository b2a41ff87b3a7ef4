r"""P-SIL and cloning of inferred actions on the paper's backbone, on any task.

python -m jaxil.launch --config=configs/psil_cloning.py:walker_run --workdir=runs/psil_c
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the settings for `task`."""
    return jaxil_config.default_config("psil_cloning", task)
