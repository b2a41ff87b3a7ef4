"""Sets GL, XLA flags and malloc, before jax and mujoco are imported.

Both read their settings once, so commands call `prepare` before they import either.
What the user has set is not changed.
"""

import ctypes
import os
import subprocess
import sys

from jaxil.errors import UsageError, unknown_name
from jaxil.machine import devices
from jaxil.machine.cache import compilation_folder

# These jaxlibs pass convolutions to YNNPACK, which takes 4 to 5 times as long for those
# whose output is kept, as in training. XLA aborts on unknown flags, so this lists only
# versions that are known to accept this one.
_JAXLIBS_WITH_YNN_FUSION = ("0.10.2",)
_NO_YNN_FUSION = "--xla_cpu_experimental_ynn_fusion_type="

# What apt-get installs on Debian and Ubuntu for GL without a screen.
GL_PACKAGES = ("libegl1", "libgl1-mesa-dri", "libosmesa6")
# EGL loads even without a driver, so the probe creates a context. It is a separate
# process because the choice of a backend is final, and has a second try because some
# drivers hang once in hundreds of tries.
_GL_PROBE = """
import os
import dm_control._render as render
context = render.Renderer(max_width=8, max_height=8)
with context.make_current() as current:
    current.call(lambda: None)
os._exit(0)
"""
_GL_PROBE_SECONDS, _GL_PROBE_TRIES = 15.0, 2
# As dm_control spells them.
NO_GL = ("disable", "disabled", "off", "false", "0")
_GLFW = ("", "glfw", "on", "enable", "enabled", "true", "1")
_GL_BACKENDS = (*_GLFW, "egl", "osmesa", *NO_GL)
# Options of glibc's malloc.h that keep freed memory in the process: all blocks come
# from one heap, which is never trimmed.
_MALLOC_SETTINGS = (
    (-8, 1),  # M_ARENA_MAX
    (-4, 0),  # M_MMAP_MAX
    (-1, -1),  # M_TRIM_THRESHOLD: the maximum
)
_MALLOC_VARIABLES = ("GLIBC_TUNABLES", "MALLOC_")  # prefixes of names


def prepare() -> str:
    """Chooses GL, XLA flags, compilation cache and allocator.

    Sets environment variables that the user has not set: `MUJOCO_GL`, `XLA_FLAGS`
    (appended to), `TF_CPP_MIN_LOG_LEVEL` and those of jax's persistent compilation
    cache. A second call changes nothing. Returns a line that describes the settings.
    """
    cpu = devices.uses_cpu()
    if cpu:
        _keep_freed_memory()
    parts = [f"jax on {'CPU' if cpu else 'an accelerator'}", choose_gl()]
    if cpu and devices.version("jaxlib") in _JAXLIBS_WITH_YNN_FUSION:
        flags = os.environ.get("XLA_FLAGS", "")
        if _NO_YNN_FUSION not in flags:
            os.environ["XLA_FLAGS"] = f"{flags} {_NO_YNN_FUSION}".strip()
            os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(compilation_folder())
        # Without these, programs that compile in under a second are not cached.
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
        _configure_imported_jax()
    parts.append(f"XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}")
    return ", ".join(parts)


def gl_works(backend: str) -> bool:
    """Returns whether `backend` ("egl", "osmesa") can create a context here."""
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


def choose_gl() -> str:
    """Sets MUJOCO_GL if it is unset; returns a few words about it.

    Raises:
      UsageError: its value is not the name of a backend.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen is not None:
        if chosen not in _GL_BACKENDS:
            known = ("egl", "osmesa", "glfw", "disable")
            raise UsageError(unknown_name("MUJOCO_GL", chosen, known))
        return f"GL {chosen or 'glfw'} (MUJOCO_GL)"
    for backend in ("egl", "osmesa"):
        if gl_works(backend):
            os.environ["MUJOCO_GL"] = backend
            return f"GL {backend}"
    # Otherwise dm_control would try to open a window and fail with an unclear message.
    os.environ["MUJOCO_GL"] = "disable"
    return f"no GL: `apt-get install {' '.join(GL_PACKAGES)}` installs it"


def _keep_freed_memory() -> None:
    """Tells malloc to keep freed memory, unless the user has configured malloc.

    An update at the paper's sizes allocates and frees 150 MB. Returning it to the
    system each time would cost 38000 page faults, 5 % of the update's time. Does
    nothing if the C library is not glibc.
    """
    if any(name.startswith(_MALLOC_VARIABLES) for name in os.environ):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for parameter, value in _MALLOC_SETTINGS:
            mallopt(parameter, value)


def _configure_imported_jax() -> None:
    """Applies the cache's settings to jax if it has already been imported."""
    jax = sys.modules.get("jax")
    if jax is None:
        return
    for name, kind in (
        ("jax_compilation_cache_dir", str),
        ("jax_persistent_cache_min_compile_time_secs", float),
        ("jax_persistent_cache_min_entry_size_bytes", int),
    ):
        jax.config.update(name, kind(os.environ[name.upper()]))
