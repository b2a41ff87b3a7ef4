r"""TemporalOT on the paper's backbone, on any task.

python -m jaxil.launch --config=configs/temporal_ot.py:cheetah_run --workdir=runs/tot
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the settings for `task`."""
    return jaxil_config.default_config("temporal_ot", task)
