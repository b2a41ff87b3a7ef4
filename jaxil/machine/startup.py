"""The machine, before first use: which GL draws, which flags XLA and malloc are given.

They are read once, when mujoco and jax are first imported, so every command calls
`prepare` before it imports either. What the user has set stays as it is.
"""

import ctypes
import glob
import hashlib
import importlib.metadata
import importlib.util
import os
import pathlib
import subprocess
import sys

from jaxil.machine.cache import cache_folder

# These jaxlibs hand convolutions to YNNPACK, which takes 4 to 5 times as long for
# those whose result is kept, as in training. An unknown flag aborts the process, so
# it goes only to versions seen to know it.
_JAXLIBS_WITH_YNN_FUSION = ("0.10.2",)
_NO_YNN_FUSION = "--xla_cpu_experimental_ynn_fusion_type="

# What apt-get needs on Debian and Ubuntu for GL without a screen.
GL_PACKAGES = ("libegl1", "libgl1-mesa-dri", "libosmesa6")
# A library that loads proves little: EGL without a driver does. So make a context,
# in a process of its own, because the choice can be made only once in each.
_GL_PROBE = """
import os
import dm_control._render as render
context = render.Renderer(max_width=8, max_height=8)
with context.make_current() as current:
    current.call(lambda: None)
os._exit(0)
"""
# Names of glibc's malloc.h, and what keeps freed memory in the process: blocks of any
# size come from one heap, which is never cut back.
_MALLOC_SETTINGS = (
    (-8, 1),  # M_ARENA_MAX
    (-4, 0),  # M_MMAP_MAX
    (-1, -1),  # M_TRIM_THRESHOLD: the greatest there is
)
_MALLOC_VARIABLES = ("GLIBC_TUNABLES", "MALLOC_")  # as they begin
_GL_PROBE_SECONDS = 15.0
_GL_PROBE_TRIES = 2  # drivers have been seen to hang, once in hundreds of tries


def prepare() -> str:
    """Chooses GL, XLA flags, compilation cache, allocator; call it before all else.

    Sets environment variables, only those that the user has not: `MUJOCO_GL`,
    `XLA_FLAGS` (appended to), `TF_CPP_MIN_LOG_LEVEL` and the ones of jax's
    persistent compilation cache. A second call changes nothing.

    Returns:
      One line that says what is in force.
    """
    cpu = uses_cpu()
    if cpu:
        _keep_freed_memory()
    parts = [f"jax on {'CPU' if cpu else 'an accelerator'}", _choose_gl()]
    if cpu and _version("jaxlib") in _JAXLIBS_WITH_YNN_FUSION:
        flags = os.environ.get("XLA_FLAGS", "")
        if _NO_YNN_FUSION not in flags:
            os.environ["XLA_FLAGS"] = f"{flags} {_NO_YNN_FUSION}".strip()
            os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(compilation_folder())
        # Without these, what compiles in under a second is compiled every time.
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
        _tell_imported_jax()
    parts.append(f"XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}")
    return ", ".join(parts)


def has_cuda_device() -> bool:
    """Returns whether an NVIDIA device is there and not hidden from CUDA."""
    if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return False
    return bool(glob.glob("/dev/nvidia[0-9]*")) or os.path.exists("/dev/dxg")


def uses_cpu() -> bool:
    """Returns whether jax will compute on the CPU, told without importing jax."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms:
        return platforms.split(",")[0].strip() == "cpu"
    has_plugin = bool(importlib.metadata.entry_points(group="jax_plugins"))
    on_gpu = has_plugin and (has_cuda_device() or os.path.exists("/dev/kfd"))
    on_tpu = importlib.util.find_spec("libtpu") is not None and bool(
        glob.glob("/dev/accel[0-9]*") or glob.glob("/dev/vfio/[0-9]*")
    )
    return not (on_gpu or on_tpu)


def gl_works(backend: str) -> bool:
    """Returns whether `backend` ("egl", "osmesa") can make a context here."""
    environment = {**os.environ, "MUJOCO_GL": backend}
    environment.pop("PYOPENGL_PLATFORM", None)
    for _ in range(_GL_PROBE_TRIES):
        try:
            probe = subprocess.run(
                [sys.executable, "-c", _GL_PROBE],
                check=False,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_GL_PROBE_SECONDS,
            )
        except subprocess.TimeoutExpired:
            continue
        return probe.returncode == 0
    return False


def available_memory_bytes(root: pathlib.Path = pathlib.Path("/")) -> int | None:
    """Returns the memory that this process may still take, None where unknown.

    The smaller of what the machine has free and what its control groups (a
    container's or a batch job's limit) leave; file caches count as free.

    Args:
      root: where /proc and /sys are; for tests.
    """
    meminfo = _read_fields(root / "proc/meminfo")
    bounds = [1024 * meminfo[name] for name in ("MemAvailable",) if name in meminfo]
    for group in _control_groups(root):
        for limit_file, usage_file, cache_field in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            limit, usage = (
                _read_number(group / limit_file),
                _read_number(group / usage_file),
            )
            if limit is not None and usage is not None:
                cached = _read_fields(group / "memory.stat").get(cache_field, 0)
                bounds.append(max(limit - max(usage - cached, 0), 0))
    return min(bounds, default=None)


def _control_groups(root: pathlib.Path) -> list[pathlib.Path]:
    """Returns the folders of this process's control groups and of their parents."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        lines = []
    folders = {root / "sys/fs/cgroup", root / "sys/fs/cgroup/memory"}
    for line in lines:
        _, controllers, path = line.split(":", 2)
        base = root / "sys/fs/cgroup"
        if "memory" in controllers.split(","):
            base /= "memory"
        elif controllers:
            continue
        here = pathlib.PurePosixPath(path.lstrip("/"))
        folders.update(base / part for part in (here, *here.parents))
    return sorted(folders)


def _read_fields(path: pathlib.Path) -> dict[str, int]:
    """Reads lines such as "MemAvailable:  123 kB" or "inactive_file 123"."""
    try:
        words = [line.split() for line in path.read_text().splitlines()]
    except OSError:
        return {}
    return {w[0].rstrip(":"): int(w[1]) for w in words if len(w) > 1 and w[1].isdigit()}


def _read_number(path: pathlib.Path) -> int | None:
    """Reads a file of one number; None where it is missing or says "max"."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def _choose_gl() -> str:
    """Sets MUJOCO_GL where it is unset and returns what to say about it."""
    chosen = os.environ.get("MUJOCO_GL")
    if chosen is not None:
        return f"GL {chosen or 'glfw'} (MUJOCO_GL)"
    for backend in ("egl", "osmesa"):
        if gl_works(backend):
            os.environ["MUJOCO_GL"] = backend
            return f"GL {backend}"
    # Left unset, dm_control would try a window, and die with an unclear message.
    os.environ["MUJOCO_GL"] = "disable"
    return f"no GL: `apt-get install {' '.join(GL_PACKAGES)}` brings one"


def _keep_freed_memory() -> None:
    """Tells malloc to keep freed memory, unless the user has settings of his own.

    An update at the paper's sizes takes and frees 150 MB; asked for anew each time, the
    system hands them out in 38000 pages of zeros, 5 % of the update's time. Without
    effect where the C library is not glibc.
    """
    if any(name.startswith(_MALLOC_VARIABLES) for name in os.environ):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for parameter, value in _MALLOC_SETTINGS:
            mallopt(parameter, value)


def _tell_imported_jax() -> None:
    """Hands the cache's settings to jax where it was imported before they were made."""
    jax = sys.modules.get("jax")
    if jax is None:
        return
    for name, kind in (
        ("jax_compilation_cache_dir", str),
        ("jax_persistent_cache_min_compile_time_secs", float),
        ("jax_persistent_cache_min_entry_size_bytes", int),
    ):
        jax.config.update(name, kind(os.environ[name.upper()]))


def compilation_folder() -> pathlib.Path:
    """Returns the folder of compiled programs for this kind of CPU and this jaxlib.

    Home folders are shared between machines, and code that was compiled for one CPU
    may contain instructions that another lacks.
    """
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    kind = sorted({line for line in lines if line.startswith(("model name", "flags"))})
    digest = hashlib.sha256("\n".join(kind).encode()).hexdigest()[:8]
    return cache_folder() / f"compiled-{_version('jaxlib')}-{digest}"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
