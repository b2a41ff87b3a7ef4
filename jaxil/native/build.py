"""Our own encoder in C, compiled for this machine's processor, known to XLA.

XLA's convolutions reach two thirds of what a CPU core can do, and take twice as many
products as 3x3 kernels need, see `launch/results/speed.md`, 10 and 12. The C compiler
is the machine's. Where there is none, and on other devices, XLA's own are used.
"""

import ctypes
import functools
import hashlib
import os
import pathlib
import shutil
import subprocess
import tempfile

import jax

from jaxil.machine import startup

_SOURCES = pathlib.Path(__file__).parent
_SOURCE = _SOURCES / "encoder.c"
_FUNCTIONS = ("jaxil_encode", "jaxil_encode_gradient")
_COMPILERS = ("gcc", "cc")
FLAGS = ("-std=gnu11", "-O3", "-march=native", "-fPIC", "-shared")
_SECONDS = 60.0  # it takes 1


@functools.cache
def problem() -> str | None:
    """Compiles the library, unless that was done before, and tells XLA about it.

    Returns:
      None if it can be used, else why it can't.
    """
    if jax.default_backend() != "cpu":
        return f"it is for CPUs, and jax computes on {jax.default_backend()}"
    try:
        library = ctypes.CDLL(str(build(startup.compilation_folder())))
    except (BuildError, OSError) as error:
        return str(error)
    register(library)
    return None


class BuildError(Exception):
    """The library can't be compiled; the message says why and what helps."""


def register(library: ctypes.CDLL) -> None:
    """Tells XLA where the functions are that `maths.encoding` calls."""
    for name in _FUNCTIONS:
        target = jax.ffi.pycapsule(getattr(library, name))
        jax.ffi.register_ffi_target(name, target, platform="cpu")


def build(folder: pathlib.Path, flags: tuple[str, ...] = FLAGS) -> pathlib.Path:
    """Returns the library's file in a folder, compiled if it isn't there.

    Args:
      folder: is made; processes may share it, processors may not.
      flags: for the compiler.

    Raises:
      BuildError: there is no compiler, or it failed.
    """
    digest = hashlib.sha256(repr(flags).encode())
    for source in (_SOURCE, *sorted(_SOURCES.glob("*.h"))):
        digest.update(source.read_bytes())
    path = folder / f"encoder-{digest.hexdigest()[:8]}.so"
    if path.exists():
        return path
    compiler = os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None:
        raise BuildError("there is no GCC: `apt-get install gcc libc6-dev` brings it")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            output = pathlib.Path(scratch) / path.name
            _compile(compiler, flags, output)
            os.replace(output, path)
    except OSError as error:
        raise BuildError(f"{folder} can't be written: {error.strerror}") from error
    return path


def _compile(compiler: str, flags: tuple[str, ...], output: pathlib.Path) -> None:
    # XLA's headers are part of jaxlib.
    words = [*compiler.split(), *flags, f"-I{jax.ffi.include_dir()}", _SOURCE]
    try:
        done = subprocess.run(
            [*words, "-o", output], capture_output=True, text=True, timeout=_SECONDS
        )
    except subprocess.TimeoutExpired as error:
        raise BuildError(f"{compiler} takes more than {_SECONDS:.0f} s") from error
    except OSError as error:
        raise BuildError(f"{compiler} can't be run: {error.strerror}") from error
    if done.returncode or not output.exists():
        lines = (done.stderr.strip() or "no message").splitlines()
        said = next((line for line in lines if "error:" in line), lines[-1])
        raise BuildError(f"{compiler} can't compile {_SOURCE.name}: {said}")
