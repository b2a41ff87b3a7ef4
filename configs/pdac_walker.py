r"""P-DAC on walker_walk from ten pixel demonstrations, as in the paper.

    python -m jaxil.launch --config=configs/pdac_walker.py --workdir=runs/pdac

Needs a GPU: 5 million frames, 1.25 million updates of batch 256.
"""

from jaxil import config as jaxil_config


def get_config():
    """Returns the paper's settings."""
    return jaxil_config.default_config("pdac", "walker_walk")
