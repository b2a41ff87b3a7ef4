r"""P-DAC at the paper's settings, on any task.

python -m jaxil.launch --config=configs/pdac.py:cheetah_run --workdir=runs/pdac
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the paper's settings for `task`."""
    return jaxil_config.default_config("pdac", task)
