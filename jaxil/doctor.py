r"""Checks whether this machine is ready for a run, and says what to do if not.

    jaxil doctor [--config=pdac:walker_walk] [--config.FIELD=V]

Prints one line per check: ok, warning or fault; what was checked; the result; advice.
Without --config it checks for the paper's settings.

Exit status: 0 no faults; 1 a fault; 2 usage error.
"""

import ctypes.util
import functools
import importlib.metadata
import os
import pathlib
import timeit
import traceback
from collections.abc import Iterator
from typing import Any, NamedTuple

from packaging.requirements import Requirement

from jaxil.errors import UsageError
from jaxil.machine import devices, startup
from jaxil.machine import memory as host_memory

_GL_INSTALL = f"apt-get install {' '.join(startup.GL_PACKAGES)}"
_JAXLIB = "jaxlib>=0.10,<0.13"  # installed by jax
_NUM_FRAMES = 50  # timed per quality
_SLOW_FRAME_MS = 8.0
_HOST_MARGIN_BYTES = 1.5e9  # jax, the learner, the simulators
_DEVICE_MARGIN_BYTES = 3e9  # the learner, and temporaries of a batch of 256 images


class Finding(NamedTuple):
    """The result of one check."""

    level: str  # "ok", "warning" or "fault"
    what: str
    value: str
    advice: str = ""

    def __str__(self) -> str:
        line = f"{self.level:<8} {self.what:<16} {self.value}"
        return f"{line}  -> {self.advice}" if self.advice else line


def examine(config: Any) -> Iterator[Finding]:
    """Runs all checks for a run of `config`; if None, those that need no config."""
    checks = [versions, gl_libraries, jax_devices, convolutions]
    checks += [rendering, memory, demonstrations] if config else []
    for check in checks:
        try:
            yield from check(config)
        # A broken package may raise anything, but must not hide the other findings.
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{pathlib.Path(where.filename).name}, line {where.lineno}"
            value = f"{type(error).__name__}: {error} ({place})"
            advice = "fix the other faults first; if there are none, report this line"
            yield Finding("fault", "examination", value, advice)


def versions(_: Any) -> Iterator[Finding]:
    """Compares the versions of packages with those that jaxil requires."""
    try:
        required = importlib.metadata.requires("jaxil") or []
    except importlib.metadata.PackageNotFoundError:  # run from a source tree
        advice = "pip install ., which also installs what it requires"
        yield Finding("warning", "jaxil", devices.NOT_INSTALLED, advice)
        required = []
    good = []
    for text in (*required, _JAXLIB):
        requirement = Requirement(text)
        if requirement.marker is not None:  # of an extra
            continue
        version = devices.version(requirement.name)
        if requirement.specifier.contains(version or "0", prereleases=True):
            good.append(f"{requirement.name} {version}")
        else:
            advice = f"pip install '{requirement}'"
            yield Finding("fault", requirement.name, version or "missing", advice)
    yield Finding("ok", "packages", ", ".join(good))


def gl_libraries(config: Any) -> Iterator[Finding]:
    """Looks for the libraries that render without a display."""
    found = {name: ctypes.util.find_library(name) for name in ("EGL", "OSMesa", "GL")}
    value = ", ".join(f"{name} {path or 'missing'}" for name, path in found.items())
    advice = "" if found["EGL"] or found["OSMesa"] else _GL_INSTALL
    yield _judged("GL libraries", value, advice, _without_gl(config))


def _without_gl(config: Any) -> str:
    """Returns how bad it is that nothing renders: a run on states has no video."""
    return "fault" if config is None or config.observation == "pixels" else "warning"


def jax_devices(_: Any) -> Iterator[Finding]:
    """Reports the devices that jax uses."""
    found, advice = devices.describe(), ""
    value = f"{found['num_devices']} x {found['device']}, {found['cores']} CPU cores"
    if found["device"].startswith("cpu") and devices.has_cuda_device():
        value += ", although there is a CUDA device"
        advice = "pip install 'jax[cuda12]', and unset JAX_PLATFORMS if it says cpu"
    yield _judged("jax devices", value, advice)


def convolutions(_: Any) -> Iterator[Finding]:
    """Compiles the encoder in C, if jax computes on the CPU."""
    from jaxil.native import build

    if not devices.device_name().startswith("cpu"):
        return
    problem = build.problem()
    advice = "XLA's are used: an update at the paper's sizes takes 2.6 times as long"
    value = problem or "in C, compiled for this processor"
    yield _judged("convolutions", value, advice if problem else "")


def rendering(config: Any) -> Iterator[Finding]:
    """Renders at each quality and times it."""
    from jaxil.environments.camera import RENDER_QUALITIES, renders_in_software

    backend, size = os.environ.get("MUJOCO_GL", ""), config.image_size
    try:
        if backend in startup.NO_GL:
            raise RuntimeError("nothing renders")
        times = {each: _render(config.task, size, each) for each in RENDER_QUALITIES}
    except (ImportError, RuntimeError) as error:
        advice = f"{_GL_INSTALL}; or unset MUJOCO_GL, if you set it"
        level = _without_gl(config)
        yield Finding(level, "MUJOCO_GL", f"{backend}: {error}", advice)
        return
    yield Finding("ok", "MUJOCO_GL", backend)
    name, _ = times["paper"]
    advice = ""
    if renders_in_software(name) and devices.has_cuda_device():
        name += ": renders on the CPU, although there is a CUDA device"
        advice = "install the NVIDIA driver's EGL (libnvidia-gl); start a container "
        advice += "with NVIDIA_DRIVER_CAPABILITIES=all"
    yield _judged("GL renderer", name, advice)
    for quality, (_, value) in times.items():
        text, advice = f"{value:.2f} ms for {size}x{size} of {config.task}", ""
        used = config.render_quality == quality == "paper"
        if used and value > _SLOW_FRAME_MS:
            advice = "--config.render_quality=fast takes "
            advice += f"{times['fast'][1]:.2f} ms and looks slightly different"
        yield _judged(f"frame, {quality}", text, advice)


def memory(config: Any) -> Iterator[Finding]:
    """Compares the available memory with the size of the full replay."""
    available = host_memory.available_bytes()
    if available is None:
        yield Finding("warning", "memory", "cannot be determined", "watch it yourself")
        return
    value = f"{available / 1e9:.1f} GB available"
    if config.observation != "pixels":  # state vectors are small
        yield Finding("ok", "memory", value)
        return
    needed, copied = replay_bytes(config)
    replay = f"the replay of {config.replay_size_steps} steps"
    if copied and devices.device_name().startswith("cpu"):
        replay, needed = f"{replay} and its device copy", needed + copied
    value += f", {replay} needs {needed / 1e9:.2f} GB"
    room = max(available - _HOST_MARGIN_BYTES, 0.0)
    fitting = int(config.replay_size_steps * room / needed) // 1000 * 1000
    advice = f"--config.replay_size_steps={max(fitting, 1000)}, or more memory"
    level = "fault" if needed > available else "warning"
    yield _judged("memory", value, advice if needed > room else "", level)
    free = devices.free_bytes()
    if copied and free is not None:
        value = f"{free / 1e9:.1f} GB free on {devices.device_name()}, the copy of the "
        value += f"replay needs {copied / 1e9:.2f} GB"
        advice = "--config.replay_on_device=False, or a smaller replay_size_steps"
        too_large = copied + _DEVICE_MARGIN_BYTES > free
        yield _judged("device memory", value, advice if too_large else "", "fault")


def demonstrations(config: Any) -> Iterator[Finding]:
    """Reads the included demonstrations and those of `config`."""
    from jaxil import config as jaxil_config
    from jaxil.demonstrations import states
    from jaxil.training import assembly

    tasks = states.shipped_tasks()
    configs = [jaxil_config.default_config(task=task) for task in tasks]
    if not tasks:
        advice = "reinstall the package: its demonstrations folder is empty"
        yield Finding("fault", "demonstrations", "none are shipped", advice)
    if jaxil_config.uses_demonstrations(config):
        configs.append(config)
    found = []
    for each in configs:
        fault = assembly.demonstration_fault(each)
        value = fault or each.demonstrations.source or f"{each.task}, shipped"
        found.append(Finding("fault" if fault else "ok", "demonstrations", value))
    yield from dict.fromkeys(found)  # the config's may be one of the shipped


def _render(task: str, image_size: int, quality: str) -> tuple[str, float]:
    """Returns the GL renderer's name and the milliseconds of one image."""
    from jaxil.environments import tasks

    with tasks.make_environment(
        task, seed=0, image_size=image_size, render_quality=quality
    ) as environment:
        environment.reset()
        if environment.frame().std() == 0:  # also creates the GL context
            raise RuntimeError("images are blank: try MUJOCO_GL=osmesa")
        seconds = timeit.timeit(environment.render, number=_NUM_FRAMES) / _NUM_FRAMES
        return environment.renderer_name(), 1e3 * seconds


def _judged(what: str, value: str, advice: str, level: str = "warning") -> Finding:
    """Returns a finding of level `level` if there is advice, else "ok"."""
    return Finding(level if advice else "ok", what, value, advice)


def _findings(argv: list[str]) -> Iterator[Finding]:
    """Reads the config, by default the paper's, and runs all checks for it."""
    config, said = None, ""
    try:
        from jaxil import command
        from jaxil import config as jaxil_config

        default = "pdac:cartpole_swingup"
        define = functools.partial(command.define_config, default=default)
        given = command.parse(argv, __doc__ or "", define).config
        # Only a process's first call tells what the user had set.
        said = startup.prepare()
        from jaxil.environments import suite

        if faults := jaxil_config.problems(given, suite.known_tasks()):
            raise UsageError(faults)
        config = given
    except (ImportError, AttributeError) as error:  # a broken jax or simulator
        yield Finding("fault", "packages", f"{type(error).__name__}: {error}")
    yield Finding("ok", "set-up", said or startup.prepare())
    yield from examine(config)


def main(argv: list[str]) -> int:
    """Prints the findings and returns the exit status."""
    num_faults = 0
    for finding in _findings(argv):
        print(finding, flush=True)
        num_faults += finding.level == "fault"
    return 1 if num_faults else 0


def replay_bytes(config: Any) -> tuple[int, int]:
    """Returns the bytes of a full replay of pixels and of its copy on the device.

    The copy, of the frames alone, is reserved at the start; 0 without one.
    """
    from jaxil.environments import tasks
    from jaxil.replay import replay

    length = config.action_repeat, config.max_episode_frames
    sizes: dict[str, Any] = {
        "capacity_steps": config.replay_size_steps,
        "episode_steps": tasks.timing(config.task, *length)[1],
        "observation_shape": (config.image_size, config.image_size, 3),
        "observation_dtype": "uint8",
    }
    copied = replay.frames_bytes(**sizes) if config.replay_on_device else 0
    return replay.memory_bytes(**sizes, action_dim=8), copied


if __name__ == "__main__":
    from jaxil.command import run

    run(main)
