r"""DAC, a baseline, at the paper's settings, on any task.

python -m jaxil.launch --config=configs/dac.py:cheetah_run --workdir=runs/dac
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the paper's settings of DAC extended to pixels for `task`."""
    return jaxil_config.default_config("dac", task)
