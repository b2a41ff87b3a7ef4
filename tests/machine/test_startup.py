"""What is set before jax and mujoco are imported, and what is left alone."""

import importlib.metadata
import json
import os
import pathlib
import sys

import pytest

from jaxil.machine import devices, startup
from jaxil.machine.cache import cache_folder
from tests.processes import run_python

OWN_VARIABLES = (
    "MUJOCO_GL",
    "XLA_FLAGS",
    "TF_CPP_MIN_LOG_LEVEL",
    "JAX_PLATFORMS",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
)
NO_YNN = "--xla_cpu_experimental_ynn_fusion_type="


@pytest.fixture(autouse=True)
def _clean_environment(monkeypatch, tmp_path):
    """An environment in which nothing is chosen, on a CPU with a known jaxlib."""
    for name in OWN_VARIABLES:
        # Set first, so that what the test sets is undone as well.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("JAXIL_CACHE", str(tmp_path))
    monkeypatch.setattr(startup, "gl_works", lambda backend: backend == "osmesa")
    monkeypatch.setattr(devices, "version", lambda package: "0.10.2")
    monkeypatch.setattr(devices, "uses_cpu", lambda: True)
    monkeypatch.setattr(startup, "_configure_imported_jax", lambda: None)
    # This is permanent; its tests have processes of their own.
    monkeypatch.setattr(startup, "_keep_freed_memory", lambda: None)


def test_prepare_chooses_what_nobody_chose(tmp_path):
    said = startup.prepare()
    assert os.environ["MUJOCO_GL"] == "osmesa"
    assert os.environ["XLA_FLAGS"] == NO_YNN
    folder = pathlib.Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    assert folder.parent == tmp_path
    assert os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] == "0"
    assert "osmesa" in said
    assert NO_YNN in said
    assert "\n" not in said


def test_prepare_twice_is_prepare_once():
    startup.prepare()
    before = dict(os.environ)
    startup.prepare()
    assert dict(os.environ) == before


def test_what_the_user_set_stays(monkeypatch, tmp_path):
    theirs = {
        "MUJOCO_GL": "glfw",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "theirs"),
        "TF_CPP_MIN_LOG_LEVEL": "0",
    }
    for name, value in theirs.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_to=/tmp/x")
    startup.prepare()
    assert {name: os.environ[name] for name in theirs} == theirs
    assert os.environ["XLA_FLAGS"] == f"--xla_dump_to=/tmp/x {NO_YNN}"
    assert "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ


def test_a_users_own_choice_of_the_flag_stays(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"{NO_YNN}2")
    startup.prepare()
    assert os.environ["XLA_FLAGS"] == f"{NO_YNN}2"


@pytest.mark.parametrize(
    ("version", "on_cpu"), [("0.10.1", True), ("0.11.0", True), ("0.10.2", False)]
)
def test_the_flag_goes_only_where_it_is_known_and_of_use(monkeypatch, version, on_cpu):
    monkeypatch.setattr(devices, "version", lambda package: version)
    monkeypatch.setattr(devices, "uses_cpu", lambda: on_cpu)
    startup.prepare()
    assert "XLA_FLAGS" not in os.environ


def test_without_gl_the_packages_are_named(monkeypatch):
    monkeypatch.setattr(startup, "gl_works", lambda backend: False)
    said = startup.prepare()
    assert os.environ["MUJOCO_GL"] == "disable"
    assert "apt-get install" in said
    assert all(package in said for package in startup.GL_PACKAGES)


def test_egl_comes_first(monkeypatch):
    monkeypatch.setattr(startup, "gl_works", lambda backend: True)
    startup.prepare()
    assert os.environ["MUJOCO_GL"] == "egl"


def test_it_runs_before_jax_and_mujoco(tmp_path):
    # The real thing, in a process of its own: nothing heavy may be imported, and jax
    # has to accept what was set.
    code = (
        "import sys, json; from jaxil.machine import startup; said = startup.prepare();"
        "early = sorted({'jax', 'mujoco', 'dm_control'} & set(sys.modules));"
        "import jax; total = float(jax.numpy.arange(4).sum());"
        "print(json.dumps([said, early, total]))"
    )
    printed = run_python(code, JAX_PLATFORMS="cpu", JAXIL_CACHE=str(tmp_path))
    said, early, total = json.loads(printed)
    assert early == []
    assert total == 6.0
    assert "GL " in said
    if importlib.metadata.version("jaxlib") == "0.10.2":
        assert NO_YNN in said
    assert list(tmp_path.glob("compiled-*/*")), "compiled programs are kept"


def test_a_backend_that_does_not_exist_does_not_work(monkeypatch):
    monkeypatch.undo()
    assert not startup.gl_works("no such backend")


@pytest.mark.parametrize(
    ("platforms", "expected"), [("cpu", True), ("cuda,cpu", False), ("cpu,cuda", True)]
)
def test_the_users_platform_decides(monkeypatch, platforms, expected):
    monkeypatch.undo()
    monkeypatch.setenv("JAX_PLATFORMS", platforms)
    assert devices.uses_cpu() is expected


def test_a_device_without_a_plugin_leaves_the_cpu(monkeypatch):
    monkeypatch.undo()
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    monkeypatch.setattr(devices, "has_cuda_device", lambda: True)
    for plugins, expected in (([], True), (["cuda"], False)):
        found = plugins
        monkeypatch.setattr(
            devices.importlib.metadata, "entry_points", lambda group, f=found: f
        )
        assert devices.uses_cpu() is expected


def test_hidden_devices_are_not_there(monkeypatch):
    monkeypatch.setattr(devices.glob, "glob", lambda pattern: ["/dev/nvidia0"])
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert devices.has_cuda_device()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert not devices.has_cuda_device()


def test_the_cache_is_where_the_user_wants_it(monkeypatch, tmp_path):
    assert cache_folder() == tmp_path
    monkeypatch.delenv("JAXIL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "jaxil"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "jaxil"


_NEW_PAGES = """
import resource
from jaxil.machine import startup
startup._keep_freed_memory()
block = bytearray(2**26)
del block
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(4):
    block = bytearray(2**26)
    del block
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def _new_pages(**variables: str) -> int:
    """Returns the pages that four blocks of 64 MB cost, after a first one."""
    return int(run_python(_NEW_PAGES, **variables))


@pytest.mark.skipif(sys.platform != "linux", reason="mallopt is glibc's")
def test_freed_memory_is_used_again():
    assert _new_pages() < 1_000


_HEAP_END = """
import ctypes
from jaxil.machine import startup
startup._keep_freed_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.sbrk.restype = ctypes.c_void_p
libc.malloc.argtypes, libc.free.argtypes = [ctypes.c_size_t], [ctypes.c_void_p]
block = libc.malloc(3 * 2**30)  # never written to, so it takes no memory
end = libc.sbrk(0)
libc.free(block)
print("no such address space" if block is None else end - libc.sbrk(0))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="mallopt is glibc's")
def test_freed_memory_is_kept_beyond_what_an_int_counts():
    given_back = run_python(_HEAP_END).strip()
    if given_back == "no such address space":
        pytest.skip(given_back)
    assert given_back == "0"


@pytest.mark.skipif(sys.platform != "linux", reason="mallopt is glibc's")
@pytest.mark.parametrize("name", ["MALLOC_ARENA_MAX", "MALLOC_TOP_PAD_"])
def test_the_users_own_allocator_settings_stay(name):
    # 4 blocks of 16384 pages each, asked for anew (fewer if pages are huge).
    assert _new_pages(**{name: "8"}) > 2 * _new_pages()
