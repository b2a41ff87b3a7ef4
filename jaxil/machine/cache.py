"""Where this machine keeps what can be made again."""

import os
import pathlib


def cache_folder() -> pathlib.Path:
    """Returns the folder of what can be computed again; it need not exist.

    $JAXIL_CACHE, else `jaxil` in the user's cache folder.
    """
    own = os.environ.get("JAXIL_CACHE")
    if own:
        return pathlib.Path(own).expanduser()
    shared = os.environ.get("XDG_CACHE_HOME")
    return pathlib.Path(shared or "~/.cache").expanduser() / "jaxil"
