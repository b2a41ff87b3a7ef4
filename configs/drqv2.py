r"""DrQ-v2 from pixels on the true reward, the learner of all other methods.

python -m jaxil.launch --config=configs/drqv2.py:cheetah_run --workdir=runs/drqv2
"""

from jaxil import config as jaxil_config


def get_config(task: str = "walker_walk"):
    """Returns the paper's settings for `task`."""
    return jaxil_config.default_config("drqv2", task)
