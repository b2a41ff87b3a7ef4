r"""The preset that learns on two CPU cores: `configs/tiny.py:METHOD,TASK`."""

from jaxil import config as jaxil_config


def get_config(argument: str = "pdac,cartpole_swingup"):
    """Returns the preset for `METHOD,TASK`."""
    method, task = argument.split(",")
    config = jaxil_config.default_config(method, task)
    return config
