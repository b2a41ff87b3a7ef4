r"""P-DAC and cloning of inferred actions on the paper's backbone, on any task.

python -m jaxil.launch --config=configs/pdac_cloning.py:walker_run --workdir=runs/pdac_c
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the settings for `task`."""
    return jaxil_config.default_config("pdac_cloning", task)
