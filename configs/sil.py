r"""SIL, a baseline, at the paper's settings, on any task.

python -m jaxil.launch --config=configs/sil.py:cheetah_run --workdir=runs/sil
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the paper's settings of SIL extended to pixels for `task`."""
    return jaxil_config.default_config("sil", task)
