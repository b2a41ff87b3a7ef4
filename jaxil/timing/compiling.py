"""How long the update takes to compile, and to be read from a cache."""

import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

_SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


def cold_and_warm(lower: Callable[[], Any]) -> tuple[float, float]:
    """Compiles twice, with a cache on disk that is empty at first.

    Everything that this process has compiled before is forgotten, so call it last.

    Args:
      lower: traces the program anew; returns what `jax.jit(f).lower(...)` does.

    Returns:
      Seconds of both times, tracing included.
    """
    before = {name: getattr(jax.config, name) for name in _SETTINGS}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name, value in zip(_SETTINGS, (folder, 0.0, -1)):
                jax.config.update(name, value)
            return _seconds(lower), _seconds(lower)
        finally:
            for name, value in before.items():
                jax.config.update(name, value)
            compilation_cache.reset_cache()


def _seconds(lower: Callable[[], Any]) -> float:
    jax.clear_caches()
    # jax opens its cache once, and keeps to it whatever the settings say later.
    compilation_cache.reset_cache()
    start = time.perf_counter()
    lower().compile()
    return time.perf_counter() - start
