r"""P-SIL on walker_walk from ten pixel demonstrations, as in the paper.

    python -m jaxil.launch --config=configs/psil_walker.py --workdir=runs/psil

Needs a GPU: 5 million frames, 1.25 million updates of batch 256.
"""

from jaxil import config as jaxil_config


def get_config():
    """Returns the paper's settings."""
    return jaxil_config.default_config("psil", "walker_walk")
