r"""Examines this machine: what will work, what will not, and what to do about it.

    python -m jaxil.doctor [--config=configs/pdac.py:walker_walk] [--config.FIELD=V]

One line for each thing examined: ok, warning or fault; what; what was found; what to
do. Without --config the paper's settings are examined.

Exit status: 0 no faults; 1 a fault; 2 wrong use.
"""

import ctypes.util
import importlib.metadata
import os
import pathlib
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxil.errors import UsageError
from jaxil.machine import startup

_GL_INSTALL = f"apt-get install {' '.join(startup.GL_PACKAGES)}"
_SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "software")
# package: lowest version that works, first one that doesn't, and why
_VERSIONS: dict[str, tuple[tuple[int, ...], tuple[int, ...], str]] = {
    "mujoco": ((3, 17), (4,), "dm-control 1.0 cannot load tasks with mujoco 4"),
    "dm-control": ((1, 0, 50), (1, 1), "it goes with mujoco 3.17 to 4"),
    "jax": ((0, 10), (0, 13), "other versions are untested"),
    "jaxlib": ((0, 10), (0, 13), "other versions are untested"),
}
_MEASURE_SECONDS = 1.0
_SLOW_FRAME_MS = 8.0
_MEMORY_MARGIN = 1.5e9  # jax, the learner, the simulators
_DEVICE_MARGIN = 3e9  # the learner and what an update of 256 images leaves behind
_NUM_TRIED_STATES = 3


class Finding(NamedTuple):
    """One thing that was examined."""

    level: str  # "ok", "warning" or "fault"
    what: str
    value: str
    advice: str = ""

    def __str__(self) -> str:
        line = f"{self.level:<8} {self.what:<16} {self.value}"
        return f"{line}  -> {self.advice}" if self.advice else line


def examine(config: Any) -> Iterator[Finding]:
    """Examines the machine for a run of `config`, thing by thing.

    Args:
      config: checked settings; None where they can't be read, which is a fault that
        the versions explain.
    """
    examinations: list[Callable[[], Iterator[Finding]]] = [
        versions,
        gl_libraries,
        lambda: rendering(config),
        devices,
        convolutions,
        lambda: memory(config),
        lambda: demonstrations(config),
    ]
    for examination in examinations:
        try:
            yield from examination()
        # A broken package may raise anything, and must not hide the other findings.
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{pathlib.Path(where.filename).name}, line {where.lineno}"
            yield Finding(
                "fault",
                "examination",
                f"{type(error).__name__}: {error} ({place})",
                "see to the other faults first; if there are none, report this line",
            )


def versions() -> Iterator[Finding]:
    """Compares installed versions with those known to work together."""
    for package, (lowest, first_bad, why) in _VERSIONS.items():
        rule = f"{package}>={_dotted(lowest)},<{_dotted(first_bad)}"
        try:
            version = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            yield Finding("fault", package, "missing", f"pip install '{rule}'")
            continue
        if lowest <= _numbers(version) < first_bad:
            yield Finding("ok", package, version)
        else:
            yield Finding("fault", package, version, f"pip install '{rule}': {why}")


def gl_libraries() -> Iterator[Finding]:
    """Looks for the libraries that draw without a screen."""
    found = {name: ctypes.util.find_library(name) for name in ("EGL", "OSMesa", "GL")}
    value = ", ".join(f"{name} {path or 'missing'}" for name, path in found.items())
    if found["EGL"] or found["OSMesa"]:
        yield Finding("ok", "GL libraries", value)
    else:
        yield Finding("fault", "GL libraries", value, _GL_INSTALL)


def rendering(config: Any) -> Iterator[Finding]:
    """Draws with the backend in force, at each quality, and times it."""
    from jaxil.environments.camera import RENDER_QUALITIES

    backend = os.environ.get("MUJOCO_GL", "")
    if backend in ("disable", "disabled", "off", "false", "0"):
        advice = f"{_GL_INSTALL}; or unset MUJOCO_GL, if you set it"
        yield Finding("fault", "MUJOCO_GL", f"{backend}: nothing renders", advice)
        return
    task, image_size = "walker_walk", 84
    if config is not None:
        task, image_size = config.task, config.image_size
    milliseconds = {}
    name = ""
    for quality in RENDER_QUALITIES:
        try:
            name, milliseconds[quality] = _frame_milliseconds(task, image_size, quality)
        except (ImportError, RuntimeError) as error:
            yield Finding("fault", "MUJOCO_GL", f"{backend}: {error}", _GL_INSTALL)
            return
    yield Finding("ok", "MUJOCO_GL", backend)
    is_software = any(word in name.lower() for word in _SOFTWARE_RENDERERS)
    if is_software and startup.has_cuda_device():
        yield Finding(
            "warning",
            "GL renderer",
            f"{name}: the processor draws, although there is a CUDA device",
            "install the NVIDIA driver's EGL (libnvidia-gl); in a container, start it "
            "with NVIDIA_DRIVER_CAPABILITIES=all",
        )
    else:
        yield Finding("ok", "GL renderer", name)
    for quality, value in milliseconds.items():
        is_used = config is not None and config.render_quality == quality
        text = f"{value:.2f} ms for {image_size}x{image_size} of {task}"
        if is_used and quality == "paper" and value > _SLOW_FRAME_MS:
            advice = (
                f"--config.render_quality=fast takes {milliseconds['fast']:.2f} ms and "
                "looks slightly different"
            )
            yield Finding("warning", f"frame, {quality}", text, advice)
        else:
            yield Finding("ok", f"frame, {quality}", text)


def devices() -> Iterator[Finding]:
    """Asks jax what it computes on."""
    import jax

    found = jax.devices()
    value = f"{len(found)} x {found[0].device_kind} ({found[0].platform})"
    if found[0].platform != "cpu":
        yield Finding("ok", "jax devices", value)
    elif startup.has_cuda_device():
        advice = "pip install 'jax[cuda12]', and unset JAX_PLATFORMS if it says cpu"
        value += f", {os.cpu_count()} cores, although there is a CUDA device"
        yield Finding("warning", "jax devices", value, advice)
    else:
        yield Finding("ok", "jax devices", f"{value}, {os.cpu_count()} cores")


def convolutions() -> Iterator[Finding]:
    """Compiles our own convolutions, where jax computes on the CPU."""
    import jax

    from jaxil.native import build

    if jax.default_backend() != "cpu":
        return
    problem = build.problem()
    if problem is None:
        yield Finding("ok", "convolutions", "our own, compiled for this processor")
    else:
        advice = (
            "XLA's are used: an update at the paper's sizes takes 1.7 times as long"
        )
        yield Finding("warning", "convolutions", problem, advice)


def memory(config: Any) -> Iterator[Finding]:
    """Compares the memory that is left with what the full replay will take."""
    available = startup.available_memory_bytes()
    if available is None:
        yield Finding("warning", "memory", "unknown here", "watch it yourself")
        return
    if config is None or config.observation != "pixels":  # states take little
        yield Finding("ok", "memory", f"{available / 1e9:.1f} GB available")
        return
    from jaxil import config as jaxil_config
    from jaxil.machine import provenance

    needed = provenance.host_memory_bytes(config)
    value = (
        f"{available / 1e9:.1f} GB available, {needed / 1e9:.2f} GB for the replay of "
        f"{config.replay_size_steps} steps"
        f"{' and its copy' if needed > jaxil_config.memory_bytes(config) else ''}"
    )
    room = max(available - _MEMORY_MARGIN, 0.0)
    fitting = int(config.replay_size_steps * room / needed) // 1000 * 1000
    shrink = f"--config.replay_size_steps={max(fitting, 1000)}, or more memory"
    if needed > available:
        yield Finding("fault", "memory", value, shrink)
    elif needed > room:
        yield Finding("warning", "memory", f"{value}: tight", shrink)
    else:
        yield Finding("ok", "memory", value)
    yield from _device_memory(config)


def _device_memory(config: Any) -> Iterator[Finding]:
    """Compares a device's memory with the copy of the replay's frames on it."""
    from jaxil import config as jaxil_config
    from jaxil.machine import provenance

    needed, free = (
        jaxil_config.device_memory_bytes(config),
        provenance.free_device_bytes(),
    )
    if not needed or free is None:  # a CPU's copy is counted with the replay
        return
    value = (
        f"{free / 1e9:.1f} GB free on {provenance.device_name()}, {needed / 1e9:.2f} GB "
        "for the copy of the replay"
    )
    fits = needed + _DEVICE_MARGIN <= free
    advice = "--config.replay_on_device=False, or a smaller replay_size_steps"
    yield Finding(
        "ok" if fits else "fault", "device memory", value, "" if fits else advice
    )


def demonstrations(config: Any) -> Iterator[Finding]:
    """Reads the shipped demonstrations, and those of `config`, and draws a little."""
    from jaxil.demonstrations import states

    shipped = states.shipped_tasks()
    if not shipped:
        advice = "install the package again; its demonstrations folder is empty"
        yield Finding("fault", "demonstrations", "none are shipped", advice)
    for task in shipped:
        yield _try_demonstrations(states.shipped_path(task), task)
    if config is None:
        return
    from jaxil import config as jaxil_config
    from jaxil.training import assembly

    if not jaxil_config.uses_demonstrations(config):
        return
    fault = assembly.demonstration_fault(config)
    source = pathlib.Path(config.demonstrations.source)
    if fault is not None:
        yield Finding("fault", "demonstrations", fault)
    elif states.recognises(source):
        yield _try_demonstrations(source, config.task)
    elif config.demonstrations.source:
        yield Finding("ok", "demonstrations", f"{source}: pixels that can be read")


def _try_demonstrations(path: pathlib.Path, task: str) -> Finding:
    from jaxil.demonstrations import rendering as drawing
    from jaxil.demonstrations import states

    try:
        stored = states.read_states(path, task=task)
        frames = drawing.observe_episodes(
            {
                name: getattr(stored, name)[:1, :_NUM_TRIED_STATES]
                for name in ("qpos", "qvel", "act")
            },
            task=task,
            seed=stored.metadata["seed"],
            first_episode=stored.metadata["first_episode"],
            image_size=48,
            render_quality="fast",
            cache=False,
        )
    except (ValueError, RuntimeError) as error:
        return Finding("fault", "demonstrations", str(error))
    mean_return = float(np.mean(stored.metadata["returns"]))
    value = f"{task}: {len(stored.rewards)} episodes, mean return {mean_return:.0f}"
    if frames.std() == 0:
        advice = "the GL driver is broken: try MUJOCO_GL=osmesa"
        return Finding("fault", "demonstrations", f"{value}, drawn blank", advice)
    return Finding("ok", "demonstrations", value)


def _frame_milliseconds(task: str, image_size: int, quality: str) -> tuple[str, float]:
    """Returns the GL renderer's name and the time of one image."""
    from jaxil.environments import suite

    environment = suite.make_environment(
        task, seed=0, image_size=image_size, render_quality=quality, observation="state"
    )
    try:
        environment.reset()
        environment.frame()  # makes the GL context
        start, num_frames = time.perf_counter(), 0
        while time.perf_counter() - start < _MEASURE_SECONDS:
            environment.frame()
            num_frames += 1
        seconds = (time.perf_counter() - start) / num_frames
        return environment.renderer.gl_name(), 1e3 * seconds
    finally:
        environment.close()


def _numbers(version: str) -> tuple[int, ...]:
    """Returns the leading numbers of a version: "3.17.0rc1" gives (3, 17)."""
    numbers = []
    for part in version.split("."):
        if not part.isdigit():
            break
        numbers.append(int(part))
    return tuple(numbers)


def _dotted(numbers: tuple[int, ...]) -> str:
    return ".".join(map(str, numbers))


def _read_config(argv: list[str]) -> Any:
    """Returns the checked config of the command line, the paper's where none is given.

    Raises:
      UsageError: wrong use.
    """
    from jaxil import command
    from jaxil import config as jaxil_config
    from jaxil.environments import suite

    gives_config = any(word.lstrip("-").startswith("config") for word in argv[1:])

    def define(values: Any) -> None:
        if gives_config or any(word.lstrip("-").startswith("h") for word in argv[1:]):
            command.define_config(values)

    values = command.parse(argv, __doc__ or "", define)
    given: Any = values["config"].value if gives_config else None
    config = jaxil_config.default_config() if given is None else given
    faults = jaxil_config.problems(config, suite.known_tasks())
    if faults:
        raise UsageError(faults)
    return config


def main(argv: list[str]) -> int:
    """Prints the findings and returns the exit status."""
    said = startup.prepare()
    try:
        config = _read_config(argv)
    except (ImportError, AttributeError) as error:  # a broken jax or simulator
        print(Finding("fault", "packages", f"{type(error).__name__}: {error}"))
        config, broken = None, True
    else:
        broken = False
    print(f"{'ok':<8} {'set-up':<16} {said}", flush=True)
    num_faults = int(broken)
    for finding in examine(config):
        print(finding, flush=True)
        num_faults += finding.level == "fault"
    return 1 if num_faults else 0


if __name__ == "__main__":
    from jaxil.command import run

    run(main)
