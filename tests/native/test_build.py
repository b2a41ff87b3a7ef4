"""Compiling the encoder in C: once, by which compiler, and messages if it fails."""

import os
import stat
import time

import jax
import pytest

from jaxil import config as jaxil_config
from jaxil import doctor
from jaxil.machine import cache
from jaxil.native import build
from jaxil.training import agent as agents
from jaxil.training import assembly
from tests.processes import run_python, wait_until_gone

NOT_FOR_THESE = (
    {"compute_dtype": "bfloat16"},
    {"observation": "state"},
    {"encoder.channels": (32, 32, 33, 32)},
    {
        "encoder.channels": (32,) * 9,
        "encoder.kernel_sizes": (3,) * 9,
        "encoder.strides": (2, *(1,) * 8),
    },
)


def changed(config, changes):
    """Returns a copy with other values, by dotted name."""
    config = config.copy_and_resolve_references()
    config.update_from_flattened_dict(changes)
    return config


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch):
    """What this process knows about the library is asked anew."""
    monkeypatch.setattr(build, "problem", build.problem.__wrapped__)


@pytest.fixture
def without_compiler(monkeypatch, tmp_path):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    monkeypatch.setattr(build.cache, "compilation_folder", lambda: tmp_path / "cache")


def compiler_that(tmp_path, script):
    path = tmp_path / "compiler"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.fixture
def quick_compiler(tmp_path_factory, monkeypatch):
    """One that copies this machine's cached library, since compiling is slow."""
    library = build.build(cache.compilation_folder())
    script = f'for last; do :; done; cp {library} "$last"'
    monkeypatch.setenv("CC", compiler_that(tmp_path_factory.mktemp("cc"), script))


@pytest.mark.usefixtures("quick_compiler")
def test_is_compiled_once_and_leaves_nothing_else(tmp_path):
    folder = tmp_path / "not" / "yet"
    path = build.build(folder)
    when = path.stat().st_mtime_ns
    assert build.build(folder) == path
    assert path.stat().st_mtime_ns == when
    assert os.listdir(folder) == [path.name]


_LOAD = """
import ctypes, pathlib, sys
from jaxil.machine import cache
from jaxil.native import build
path = build.build(pathlib.Path(sys.argv[1]))
build.register(ctypes.CDLL(str(path)))
"""


@pytest.mark.usefixtures("quick_compiler")
def test_a_damaged_library_is_rebuilt(tmp_path):
    path = build.build(tmp_path)
    whole = path.read_bytes()
    half = len(whole) // 2
    flipped = whole[:half] + bytes([whole[half] ^ 1]) + whole[half + 1 :]
    for damaged in (b"", flipped):
        path.write_bytes(damaged)
        assert build.build(tmp_path) == path
        assert path.read_bytes() == whole
    path.write_bytes(whole[:half])
    # Loading it would kill the process.
    run_python(_LOAD, str(tmp_path))
    assert path.read_bytes() == whole
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.usefixtures("quick_compiler")
def test_another_processor_is_another_library(tmp_path, monkeypatch):
    path = build.build(tmp_path)
    monkeypatch.setattr(build.devices, "instruction_set", lambda: "flags : avx2 fma")
    assert build.build(tmp_path) != path


@pytest.mark.usefixtures("quick_compiler")
def test_other_flags_are_another_library(tmp_path):
    assert build.build(tmp_path) != build.build(tmp_path, (*build.FLAGS, "-g"))
    assert len(os.listdir(tmp_path)) == 2


@pytest.mark.usefixtures("quick_compiler")
def test_the_users_compiler_is_taken_with_its_options(tmp_path, monkeypatch):
    seen = tmp_path / "seen"
    script = f'echo "$1" > {seen}; shift; exec {os.environ["CC"]} "$@"'
    monkeypatch.setenv("CC", compiler_that(tmp_path, script) + " --first")
    assert build.build(tmp_path / "cache").exists()
    assert seen.read_text() == "--first\n"


@pytest.mark.usefixtures("without_compiler")
def test_without_a_compiler_xlas_convolutions_are_used():
    assert "apt-get install gcc libc6-dev" in (build.problem() or "")
    config = jaxil_config.default_config()
    assert not agents.uses_native_convolutions(config)
    networks = agents.make_networks(config, 1, 0.5)
    assert not networks.encoder.native
    (finding,) = doctor.convolutions(None)
    assert finding.level == "warning"
    assert "apt-get install gcc libc6-dev" in finding.value


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo 'encoder.c:1: error: no' >&2; exit 1", "encoder.c:1: error: no"),
        ("exit 3", "no message"),
        ("echo text > $9; exit 0", "too short"),  # a file that is no library
        ("exit 0", "no message"),
    ],
)
def test_a_compiler_that_fails_is_named(tmp_path, monkeypatch, script, message):
    compiler = compiler_that(tmp_path, script)
    monkeypatch.setenv("CC", compiler)
    folder = tmp_path / "cache"
    monkeypatch.setattr(build.cache, "compilation_folder", lambda: folder)
    problem = build.problem()
    assert problem is not None
    assert message in problem
    assert "\n" not in problem
    assert list(folder.iterdir()) == []


def test_a_compiler_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", str(tmp_path / "missing"))
    with pytest.raises(build.BuildError, match="missing"):
        build.build(tmp_path)


def test_an_older_processor_is_named(tmp_path):
    flags = [flag for flag in build.FLAGS if not flag.startswith("-march")]
    with pytest.raises(build.BuildError, match="processors with AVX2 and FMA"):
        build.build(tmp_path, (*flags, "-march=x86-64"))


def test_a_compiler_that_hangs_is_given_up(tmp_path, monkeypatch):
    script = f"sleep 300 & echo $! > {tmp_path}/child; wait"  # like gcc and its cc1
    monkeypatch.setenv("CC", compiler_that(tmp_path, script))
    monkeypatch.setattr(build, "_COMPILE_SECONDS", 2.0)
    begin = time.monotonic()
    with pytest.raises(build.BuildError, match="exceeds 2 s"):
        build.build(tmp_path / "cache")
    assert time.monotonic() - begin < 200
    wait_until_gone([int((tmp_path / "child").read_text())])


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(build.BuildError, match="file/cache cannot be written"):
        build.build(tmp_path / "file" / "cache")


def test_it_is_for_cpus_only(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "gpu" in (build.problem() or "")
    monkeypatch.setattr(doctor.devices, "device_name", lambda: "gpu: H100")
    assert list(doctor.convolutions(None)) == []


def test_the_config_chooses():
    config = jaxil_config.default_config()
    assert agents.uses_native_convolutions(config)
    assert agents.make_networks(config, 1, 0.5).encoder.native
    (finding,) = doctor.convolutions(None)
    assert finding.level == "ok"
    for changes in NOT_FOR_THESE:
        assert not agents.uses_native_convolutions(changed(config, changes))
    config.encoder.convolutions = "xla"
    assert not agents.uses_native_convolutions(config)


@pytest.mark.parametrize("changes", NOT_FOR_THESE)
def test_who_insists_is_told_what_they_are_not_for(changes):
    config = jaxil_config.default_config()
    config.encoder.convolutions = "native"
    assert assembly.problems(config) == []
    (fault,) = assembly.problems(changed(config, changes))
    assert f"{next(iter(changes))}=" in str(fault)


@pytest.mark.usefixtures("without_compiler")
def test_who_insists_is_told_before_anything_starts():
    config = jaxil_config.default_config()
    config.encoder.convolutions = "native"
    (fault,) = assembly.problems(config)
    assert "encoder.convolutions='native'" in str(fault)
    assert "apt-get install gcc libc6-dev" in str(fault)


def test_a_broken_encoder_is_the_only_fault():
    config = jaxil_config.default_config()
    config.encoder.convolutions = "native"
    config.encoder.channels = (32, "32", 32, 32)
    (fault,) = assembly.problems(config)
    assert "encoder.channels" in str(fault)


def test_an_unknown_form_is_a_fault():
    config = jaxil_config.default_config()
    config.encoder.convolutions = "cuda"
    (fault,) = assembly.problems(config)
    assert "auto, native, xla" in str(fault)
