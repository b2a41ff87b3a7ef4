"""launch/setup.sh, with an interpreter that only notes what it is asked to do."""

import os
import pathlib
import shutil
import signal
import subprocess
import time

import pytest

from tests.commands import ROOT

_PYTHON = """#!/bin/sh
case "$*" in
  *version_info*) echo "${VERSION:-3.11}" ;;
  *sys.version*) echo "3.11.7 (stub)" ;;
  "-m venv "*) rm -rf "$4" && mkdir -p "$4/bin" && cp "$0" "$4/bin/python"
    echo venv >>"$NOTES" ;;
  "-m pip "*) echo "pip begins: $*" >>"$NOTES"; sleep "${PIP_SECONDS:-0}"
    [ -z "$PIP_FAILS" ] || { echo "no such package"; exit 1; }
    echo "pip ends" >>"$NOTES" ;;
  "-m jaxil.launch "*) echo "${*#-m jaxil.}" >>"$NOTES" ;;
esac
"""


@pytest.fixture(name="project")
def _project(tmp_path):
    (tmp_path / "launch").mkdir()
    launch = ("launch/setup.sh", "launch/quickstart.sh", "launch/constraints.txt")
    for name in ("setup.cfg", *launch):
        shutil.copy(ROOT / name, tmp_path / name)
    python = tmp_path / "other-python"
    python.write_text(_PYTHON)
    python.chmod(0o755)
    return tmp_path


def start(project: pathlib.Path, extras: str, **variables: str) -> subprocess.Popen:
    own = {"PYTHON": str(project / "other-python"), "NOTES": str(project / "notes")}
    return subprocess.Popen(
        ["bash", "-euc", f"source launch/setup.sh; set_up '{extras}'"],
        cwd=project,
        env={**os.environ, "CC": "true", **own, **variables},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def run(project: pathlib.Path, extras: str = "dev", **variables: str):
    """Returns the exit status, what was printed, and the notes so far."""
    process = start(project, extras, **variables)
    _, printed = process.communicate(timeout=60)
    return process.returncode, printed, notes(project)


def notes(project: pathlib.Path) -> list[str]:
    path = project / "notes"
    return path.read_text().splitlines() if path.exists() else []


def test_installs_once_at_the_pinned_versions(project):
    status, _, found = run(project)
    assert status == 0
    assert [line.split(":")[0] for line in found] == ["venv", "pip begins", "pip ends"]
    assert "-c launch/constraints.txt -e .[dev]" in found[1]
    assert run(project) == (0, "", found)
    # "dev" includes the project itself; "gpu" is added to the same .venv.
    assert run(project, "") == (0, "", found)
    assert run(project, "gpu")[2].count("venv") == 1
    assert run(project)[2] == run(project, "gpu")[2]


def test_other_versions_are_installed_into_the_same_environment(project):
    run(project)
    with (project / "launch/constraints.txt").open("a") as file:
        file.write("one-more==1\n")
    _, _, found = run(project)
    assert (found.count("venv"), found.count("pip ends")) == (1, 2)


def test_what_was_cut_off_is_rebuilt(project):
    process = start(project, "dev", PIP_SECONDS="30")
    while not any("begins" in line for line in notes(project)):
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    status, printed, found = run(project)
    assert status == 0
    assert "rebuilding" in printed
    assert (found.count("venv"), found.count("pip ends")) == (2, 1)


def test_a_failure_shows_the_log(project):
    status, printed, _ = run(project, PIP_FAILS="1")
    assert status == 1
    assert "no such package" in printed
    assert run(project)[0] == 0


def test_two_at_once_take_turns(project):
    first = start(project, "dev", PIP_SECONDS="2")
    while not notes(project):
        time.sleep(0.05)
    status, printed, found = run(project)
    first.communicate(timeout=60)
    assert (status, first.returncode) == (0, 0)
    assert "Waiting for another set-up" in printed
    assert found.count("pip ends") == 1


def test_other_pythons_are_refused(project):
    status, printed, found = run(project, VERSION="3.13")
    assert (status, found) == (2, [])
    assert "PYTHON=PATH" in printed


_CONFIG = "--config=tiny:psil,ball_in_cup_catch"
_DEFAULTS = _CONFIG, "--workdir=runs/quickstart"


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ((), _DEFAULTS),
        (("--config.seed=1",), (*_DEFAULTS, "--config.seed=1")),
        (("--workdir", "runs/x"), (_CONFIG, "--workdir", "runs/x")),
        (("--config=a.py", "--workdir=b"), ("--config=a.py", "--workdir=b")),
        (("--config", "a.py"), ("--config", "a.py")),
    ],
)
def test_the_quickstart_fills_in_what_is_not_said(project, flags, expected):
    variables = {"PYTHON": str(project / "other-python"), "CC": "true"}
    variables |= {"NOTES": str(project / "notes"), "JAX_PLATFORMS": "cpu"}
    subprocess.run(
        ["bash", "launch/quickstart.sh", *flags],
        cwd=project,
        env={**os.environ, **variables},
        check=True,
        timeout=60,
    )
    assert notes(project)[-1] == " ".join(("launch", *expected))
