r"""The preset that learns on two CPU cores, the same as `--config=tiny:METHOD,TASK`.

    python -m jaxil.launch --config=configs/tiny.py:pdac,cartpole_swingup \
        --workdir=runs/tiny
"""

from jaxil.presets.tiny import get_config

__all__ = ["get_config"]
