"""The doctor's findings on machines that lack this or that."""

import importlib.metadata
import os

import numpy as np
import pytest

from jaxil import config as jaxil_config
from jaxil import doctor
from jaxil.demonstrations import states
from jaxil.environments import pixel_environment, tasks
from jaxil.errors import UsageError
from jaxil.machine import devices, memory, provenance, startup


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(doctor, "_NUM_FRAMES", 1)


@pytest.fixture(name="config")
def _config():
    config = jaxil_config.default_config("drqv2")
    config.image_size = 48
    return config


def one(findings, what):
    """Returns the only finding about `what`."""
    found = [finding for finding in findings if finding.what == what]
    assert len(found) == 1, found
    return found[0]


def test_a_line_says_level_what_value_and_advice():
    assert str(doctor.Finding("ok", "jax", "0.10.2")).split() == ["ok", "jax", "0.10.2"]
    line = str(doctor.Finding("fault", "jax", "0.9", "pip install"))
    assert line.startswith("fault ")
    assert line.endswith("0.9  -> pip install")


def test_this_machine_passes(config, monkeypatch):
    monkeypatch.setattr(states, "shipped_tasks", lambda: ())
    findings = list(doctor.examine(config))
    faults = [finding for finding in findings if finding.level == "fault"]
    assert [fault.value for fault in faults] == ["none are shipped"]
    assert "48x48 of cartpole_swingup" in one(findings, "frame, fast").value
    assert one(findings, "MUJOCO_GL").value == os.environ["MUJOCO_GL"]
    assert one(findings, "GL renderer").value
    assert "cpu" in one(findings, "jax devices").value
    assert one(findings, "memory").level == "ok"


@pytest.mark.parametrize(
    ("package", "version", "level"),
    [
        ("mujoco", "4.0.0", "fault"),
        ("mujoco", "3.16.9", "fault"),
        ("mujoco", "3.17.0", "ok"),
        ("mujoco", "3.18.1rc1", "ok"),
        ("dm-control", "1.0.49", "fault"),
        ("dm-control", "1.0.50", "ok"),
        ("dm-control", "1.1.0", "fault"),
        ("jax", "0.13.0", "fault"),
        ("jax", "0.12.3", "ok"),
        ("jaxlib", "0.9.2", "fault"),
    ],
)
def test_versions_known_to_clash(monkeypatch, package, version, level):
    real = importlib.metadata.version
    monkeypatch.setattr(
        importlib.metadata,
        "version",
        lambda name: version if name == package else real(name),
    )
    findings = list(doctor.versions(None))
    faults = [finding for finding in findings if finding.level == "fault"]
    if level == "ok":
        assert faults == []
        assert f"{package} {version}" in one(findings, "packages").value
    else:
        (fault,) = faults
        assert (fault.what, fault.value) == (package, version)
        assert f"pip install '{package}<" in fault.advice


def test_a_missing_package_is_a_fault(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    finding = one(doctor.versions(None), "mujoco")
    assert (finding.level, finding.value) == ("fault", "missing")


def test_a_source_tree_that_is_not_installed(monkeypatch):
    """On the module path alone, jaxil has no version."""
    real = importlib.metadata.Distribution.from_name

    def from_name(name):
        if name == "jaxil":
            raise importlib.metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(importlib.metadata.Distribution, "from_name", from_name)
    finding = one(doctor.versions(None), "jaxil")
    assert (finding.level, finding.value) == ("warning", "not installed")
    assert "jaxlib" in one(doctor.versions(None), "packages").value
    versions = provenance.describe("egl", native=False)["versions"]
    assert versions["jaxil"] == "not installed"
    assert versions["jax"] == real("jax").version
    metadata = states.new_metadata(
        task="cartpole_swingup",
        action_repeat=2,
        seed=0,
        expert="none",
        rewards=np.zeros((1, 3)),
    )
    assert metadata["versions"]["jaxil"] == "not installed"


def test_missing_gl_libraries(monkeypatch):
    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda name: None)
    finding = one(doctor.gl_libraries(None), "GL libraries")
    assert finding.level == "fault"
    assert "libegl1" in finding.advice
    monkeypatch.setattr(
        doctor.ctypes.util,
        "find_library",
        lambda name: "libOSMesa.so.8" if name == "OSMesa" else None,
    )
    assert one(doctor.gl_libraries(None), "GL libraries").level == "ok"


def test_nothing_renders(monkeypatch, config):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert one(doctor.rendering(config), "MUJOCO_GL").level == "fault"
    config.observation = "state"  # which needs no rendering, as of an expert
    assert one(doctor.rendering(config), "MUJOCO_GL").level == "warning"
    config.observation = "pixels"

    def fail(*_, **__):
        raise RuntimeError("nothing here can render")

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(tasks, "make_environment", fail)
    finding = one(doctor.rendering(config), "MUJOCO_GL")
    assert (finding.level, "egl" in finding.value) == ("fault", True)
    assert "apt-get install" in finding.advice


@pytest.mark.parametrize(
    ("renderer", "has_cuda", "level"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True, "warning"),
        ("softpipe", True, "warning"),
        ("llvmpipe (LLVM 15.0.6, 256 bits)", False, "ok"),
        ("NVIDIA H100 PCIe/PCIe/SSE2", True, "ok"),
    ],
)
def test_software_beside_a_device_is_warned_of(
    monkeypatch, config, renderer, has_cuda, level
):
    monkeypatch.setattr(doctor, "_render", lambda *_: (renderer, 1.0))
    monkeypatch.setattr(devices, "has_cuda_device", lambda: has_cuda)
    finding = one(doctor.rendering(config), "GL renderer")
    assert finding.level == level
    assert renderer in finding.value


def test_slow_frames_are_warned_of_where_they_are_used(monkeypatch, config):
    times = {"paper": 25.0, "fast": 1.5, "smooth": 2.5}
    monkeypatch.setattr(doctor, "_render", lambda task, size, q: ("GPU", times[q]))
    finding = one(doctor.rendering(config), "frame, paper")
    assert finding.level == "warning"
    assert "--config.render_quality=fast takes 1.50 ms" in finding.advice
    config.render_quality = "fast"
    assert one(doctor.rendering(config), "frame, paper").level == "ok"


def test_jax_on_the_cpu_beside_a_device_is_warned_of(monkeypatch):
    monkeypatch.setattr(devices, "has_cuda_device", lambda: True)
    finding = one(doctor.jax_devices(None), "jax devices")
    assert finding.level == "warning"
    assert "jax[cuda12]" in finding.advice


def test_memory_is_compared_with_the_replay(monkeypatch, config):
    needed = doctor.replay_bytes(config)[0]
    levels = {}
    for available in (0.5 * needed, needed + 1e9, needed + 4e9):
        monkeypatch.setattr(
            memory, "available_bytes", lambda bytes=available: int(bytes)
        )
        levels[available] = one(doctor.memory(config), "memory").level
    assert list(levels.values()) == ["fault", "warning", "ok"]
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    assert one(doctor.memory(config), "memory").level == "warning"


def test_short_episodes_need_a_frame_more_each(config):
    config.replay_on_device, config.max_episode_frames = True, 2 * config.action_repeat
    frames = doctor.replay_bytes(config)[1]
    assert frames == 1.5 * config.replay_size_steps * 48 * 48 * 3


def test_states_take_little_memory(monkeypatch, config):
    monkeypatch.setattr(memory, "available_bytes", lambda: int(1e9))
    config.observation = "state"
    assert one(doctor.memory(config), "memory").level == "ok"


def test_a_copy_on_the_device_is_counted_where_it_lies(monkeypatch, config):
    plain = doctor.replay_bytes(config)[0]
    config.replay_on_device = True
    frames = doctor.replay_bytes(config)[1]
    # 150000 steps in 300 episodes of 500: one frame more in each.
    assert frames == 150_300 * 48 * 48 * 3
    monkeypatch.setattr(memory, "available_bytes", lambda: int(plain + 2e9))
    monkeypatch.setattr(devices, "device_name", lambda: "cpu: cpu")
    monkeypatch.setattr(devices, "free_bytes", lambda: None)
    assert one(doctor.memory(config), "memory").level == "warning"  # there twice
    assert (
        f"needs {(plain + frames) / 1e9:.2f}"
        in one(doctor.memory(config), "memory").value
    )
    monkeypatch.setattr(devices, "device_name", lambda: "gpu: NVIDIA H100")
    for free, level in ((1e9, "fault"), (10e9, "ok")):
        monkeypatch.setattr(devices, "free_bytes", lambda free=free: int(free))
        found = list(doctor.memory(config))
        assert one(found, "memory").level == "ok"
        assert one(found, "device memory").level == level
        assert "NVIDIA H100" in one(found, "device memory").value


def test_the_advised_replay_fits(monkeypatch, config):
    config.replay_size_steps = 10_000_000
    monkeypatch.setattr(memory, "available_bytes", lambda: int(4e9))
    advice = one(doctor.memory(config), "memory").advice
    field, _, rest = advice.removeprefix("--config.").partition("=")
    config[field] = int(rest.split(",")[0])
    assert one(doctor.memory(config), "memory").level == "ok"


def test_demonstrations_that_cannot_be_used(monkeypatch, tmp_path):
    config = jaxil_config.default_config("pdac")
    config.demonstrations.source = str(tmp_path / "none.npz")
    findings = list(doctor.demonstrations(config))
    assert findings[-1].level == "fault"
    assert "none.npz cannot be read" in findings[-1].value

    broken = tmp_path / "walker_walk.npz"
    broken.write_bytes(b"PK")
    monkeypatch.setattr(states, "_shipped_folder", lambda: tmp_path)
    first = next(doctor.demonstrations(config))
    assert (first.level, str(broken) in first.value) == ("fault", True)


def test_blank_images_are_a_fault(monkeypatch, config):
    blank = np.zeros((48, 48, 3), np.uint8)
    monkeypatch.setattr(pixel_environment.PixelEnvironment, "frame", lambda _: blank)
    finding = one(doctor.rendering(config), "MUJOCO_GL")
    assert finding.level == "fault"
    assert "MUJOCO_GL=osmesa" in finding.value


def test_an_examination_that_breaks_does_not_hide_the_others(monkeypatch, config):
    def broken(config):
        raise AttributeError("no attribute flex_vertedge")

    for name in ("rendering", "demonstrations"):
        monkeypatch.setattr(doctor, name, broken)
    findings = list(doctor.examine(config))
    broken_findings = [finding for finding in findings if finding.what == "examination"]
    assert len(broken_findings) == 2
    assert "flex_vertedge" in broken_findings[0].value
    assert "test_doctor.py" in broken_findings[0].value
    assert one(findings, "memory")


# --- the command ----------------------------------------------------------------------


@pytest.fixture(name="few")
def _few(monkeypatch):
    """Replaces the examinations by a list of levels."""

    def set_levels(*levels):
        findings = [doctor.Finding(level, "thing", "value") for level in levels]
        monkeypatch.setattr(doctor, "examine", lambda config: iter(findings))

    return set_levels


@pytest.mark.parametrize(
    ("levels", "status"), [(("ok", "warning"), 0), (("ok", "fault", "ok"), 1)]
)
def test_exit_status(few, capsys, levels, status):
    few(*levels)
    assert doctor.main(["doctor"]) == status
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["ok", *levels]


def test_the_set_up_is_told_as_the_user_left_it(few, capsys, monkeypatch):
    """`prepare` sets MUJOCO_GL, so that its second call would blame the user for it."""
    few()
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr(startup, "gl_works", lambda backend: False)
    assert doctor.main(["doctor"]) == 0
    assert "no GL: `apt-get install" in capsys.readouterr().out


def test_the_config_of_the_command_line_is_examined(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(doctor, "examine", lambda config: seen.append(config) or [])
    path = tmp_path / "mine.py"
    path.write_text(
        "from jaxil import config\n"
        "def get_config(task):\n"
        "    return config.default_config('psil', task)\n"
    )
    argv = ["doctor", f"--config={path}:walker_run", "--config.image_size=64"]
    assert doctor.main(argv) == 0
    assert (seen[0].method, seen[0].task, seen[0].image_size) == (
        "psil",
        "walker_run",
        64,
    )
    assert doctor.main(["doctor", "--config.image_size=96"]) == 0
    assert (seen[1].method, seen[1].task, seen[1].image_size) == (
        "pdac",
        "cartpole_swingup",
        96,
    )
    with pytest.raises(UsageError, match="image_size=3"):
        doctor.main([*argv[:2], "--config.image_size=3"])
    with pytest.raises(UsageError, match="image_sice"):
        doctor.main([*argv[:2], "--config.image_sice=64"])


def test_wrong_use_is_said_before_anything_is_examined(few, capsys):
    few("ok")
    with pytest.raises(UsageError, match="--nonsense"):
        doctor.main(["doctor", "--nonsense"])
    assert capsys.readouterr().out == ""
