"""The encoder in C: compiled for this machine's processor, registered with XLA.

XLA's convolutions reach two thirds of a CPU core's peak and compute twice as many
products as 3x3 kernels need: `launch/results/speed_diary.md`, changes 10 and 12.
Without a C compiler, and on other devices, XLA's convolutions are used.
"""

import ctypes
import functools
import hashlib
import os
import pathlib
import shutil
import signal
import subprocess
import tempfile

import jax

from jaxil.machine import cache, devices

_SOURCES = pathlib.Path(__file__).parent
_SOURCE = _SOURCES / "encoder.c"
_FUNCTIONS = ("jaxil_encode", "jaxil_encode_gradient")
_COMPILERS = ("gcc", "cc")
FLAGS = ("-std=gnu11", "-O3", "-march=native", "-fPIC", "-shared")
_COMPILE_SECONDS = 60.0  # it takes 1
_DIGEST_BYTES = 32  # SHA-256, appended to the library; the loader ignores it


class BuildError(Exception):
    """The library cannot be compiled; the message says why and what to do."""


@functools.cache
def problem() -> str | None:
    """Loads the library and registers its functions; returns why it failed, or None."""
    if jax.default_backend() != "cpu":
        return f"it is for CPUs, and jax computes on {jax.default_backend()}"
    try:
        path = build(cache.compilation_folder())
    except BuildError as error:
        return str(error)
    try:
        register(ctypes.CDLL(str(path)))
    except (AttributeError, OSError) as error:
        path.unlink(missing_ok=True)  # the compiler wrote something else
        return str(error)
    return None


def register(library: ctypes.CDLL) -> None:
    """Registers the functions that `native.encoding` calls with XLA."""
    for name in _FUNCTIONS:
        target = jax.ffi.pycapsule(getattr(library, name))
        jax.ffi.register_ffi_target(name, target, platform="cpu")


def build(folder: pathlib.Path, flags: tuple[str, ...] = FLAGS) -> pathlib.Path:
    """Returns the path of the library, compiled if it is missing or damaged.

    The folder is created if missing; processes and machines may share it.

    Raises:
      BuildError: there is no compiler, or it failed.
    """
    # -march=native depends on the instruction set.
    key = hashlib.sha256(repr((flags, devices.instruction_set())).encode())
    for source in (_SOURCE, *sorted(_SOURCES.glob("*.h"))):
        key.update(source.read_bytes())
    path = folder / f"encoder-{key.hexdigest()[:8]}.so"
    if _is_whole(path):
        return path
    compiler = os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None:
        raise BuildError("there is no GCC: `apt-get install gcc libc6-dev` installs it")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            output = pathlib.Path(scratch) / path.name
            _compile(compiler, flags, output)
            digest = hashlib.sha256(output.read_bytes()).digest()
            with output.open("ab") as file:
                file.write(digest)
                file.flush()
                os.fsync(file.fileno())
            os.replace(output, path)
    except OSError as error:
        raise BuildError(f"{folder} cannot be written: {error.strerror}") from error
    return path


def _is_whole(path: pathlib.Path) -> bool:
    """Returns whether a library ends in the digest of what comes before.

    Checked first, because loading a truncated library kills the process with SIGBUS.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return False
    library, digest = content[:-_DIGEST_BYTES], content[-_DIGEST_BYTES:]
    return hashlib.sha256(library).digest() == digest


def _compile(compiler: str, flags: tuple[str, ...], output: pathlib.Path) -> None:
    # XLA's headers are part of jaxlib.
    include = f"-I{jax.ffi.include_dir()}"
    command = [*compiler.split(), *flags, include, _SOURCE, "-o", output]
    try:
        process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            process_group=0,  # with the processes that the compiler starts
        )
    except OSError as error:
        raise BuildError(f"{compiler} cannot be run: {error.strerror}") from error
    try:
        _, said = process.communicate(timeout=_COMPILE_SECONDS)
    except BaseException as error:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        if not isinstance(error, subprocess.TimeoutExpired):
            raise
        raise BuildError(f"{compiler} exceeds {_COMPILE_SECONDS:.0f} s") from error
    if process.returncode or not output.exists():
        lines = (said.strip() or "no message").splitlines()
        reason = next((line for line in lines if "error:" in line), lines[-1])
        raise BuildError(f"{compiler} cannot compile {_SOURCE.name}: {reason}")
