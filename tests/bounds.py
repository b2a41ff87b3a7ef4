"""Bounds of time and memory, for what reads hostile files."""

import contextlib
import time
import tracemalloc


@contextlib.contextmanager
def bounded(seconds: float = 60.0, num_bytes: float = 10**7):
    """Fails unless what is inside ends soon and allocates little."""
    start = time.monotonic()
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < num_bytes
        assert time.monotonic() - start < seconds
    finally:
        tracemalloc.stop()
