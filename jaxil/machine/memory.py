"""The host's memory: what is available, and what this process has used."""

import functools
import pathlib
import resource

_ASSUMED_BYTES = 4 * 2**30  # if unknown


def available_bytes(root: pathlib.Path = pathlib.Path("/")) -> int | None:
    """Returns the memory that this process may still allocate, None if unknown.

    The minimum of the machine's free memory and what control groups (of a container or
    a batch job) allow. File caches count as free. `root` is for tests.
    """
    meminfo = _read_fields(root / "proc/meminfo")
    bounds = [1024 * meminfo["MemAvailable"]] if "MemAvailable" in meminfo else []
    for group in _control_groups(root):
        for limit_file, usage_file, cache_field in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            limit = _read_number(group / limit_file)
            usage = _read_number(group / usage_file)
            if limit is not None and usage is not None:
                cached = _read_fields(group / "memory.stat").get(cache_field, 0)
                bounds.append(max(limit - max(usage - cached, 0), 0))
    return min(bounds, default=None)


@functools.cache
def spare_bytes() -> int:
    """Returns how much memory demonstrations may use: half of what is available.

    Measured once: a file that was checked is in memory when it is loaded, and must not
    be refused then.
    """
    available = available_bytes() or _ASSUMED_BYTES
    return max(available // 2, 2**30)


def peak_bytes() -> int:
    """Returns the peak memory of this process."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _control_groups(root: pathlib.Path) -> list[pathlib.Path]:
    """Returns the folders of this process's control groups and their parents."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        lines = []
    base = root / "sys/fs/cgroup"
    folders = {base, base / "memory"}
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        here = pathlib.PurePosixPath(path.lstrip("/"))
        hierarchy = base / "memory" if controllers else base
        folders.update(hierarchy / part for part in (here, *here.parents))
    return sorted(folders)


def _read_fields(path: pathlib.Path) -> dict[str, int]:
    """Reads lines such as "MemAvailable:  123 kB" or "inactive_file 123"."""
    try:
        words = [line.split() for line in path.read_text().splitlines()]
    except OSError:
        return {}
    return {w[0].rstrip(":"): int(w[1]) for w in words if len(w) > 1 and w[1].isdigit()}


def _read_number(path: pathlib.Path) -> int | None:
    """Reads a number from a file; None if it is missing or says "max"."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
