r"""Experts in minutes, the same as `--config=expert:TASK`.

    python -m jaxil.launch --config=configs/expert.py:cartpole_swingup \
        --workdir=runs/expert
"""

from jaxil.presets.expert import get_config

__all__ = ["get_config"]
