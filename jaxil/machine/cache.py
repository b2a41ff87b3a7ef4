"""Folders of cached files."""

import hashlib
import os
import pathlib

from jaxil.machine import devices


def cache_folder() -> pathlib.Path:
    """Returns $JAXIL_CACHE, else `jaxil` in the user's cache folder."""
    own = os.environ.get("JAXIL_CACHE")
    if own:
        return pathlib.Path(os.path.expanduser(own))
    shared = os.environ.get("XDG_CACHE_HOME")
    return pathlib.Path(os.path.expanduser(shared or "~/.cache"), "jaxil")


def compilation_folder() -> pathlib.Path:
    """Returns the folder of programs compiled for this processor and jaxlib."""
    digest = hashlib.sha256(devices.instruction_set().encode()).hexdigest()[:8]
    return cache_folder() / f"compiled-{devices.version('jaxlib')}-{digest}"
