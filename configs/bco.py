r"""BCO on the paper's backbone, on any task.

python -m jaxil.launch --config=configs/bco.py:cheetah_run --workdir=runs/bco
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the settings for `task`."""
    return jaxil_config.default_config("bco", task)
