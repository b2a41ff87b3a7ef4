"""A report is replaced as a whole, and nothing else ever is."""

import pathlib
import signal
import subprocess
import sys

import pytest

from jaxil.reporting import folder
from tests.commands import ROOT


def write(output, text):
    with folder.replaced(output) as new:
        (new / "index.html").write_text(f"{folder.MARK}{text}")
        (new / "tables" / "runs.csv").write_text(text)


def names(path):
    return sorted(entry.name for entry in path.iterdir())


def test_a_report_replaces_a_report(tmp_path):
    output = tmp_path / "deep" / "report"
    for text in ("old", "new"):
        write(output, text)
        assert folder.problems(output) == []
        assert (output / "tables" / "runs.csv").read_text() == text
        assert names(output) == ["figures", "index.html", "tables"]
        assert names(tmp_path / "deep") == ["report"]


def test_a_failure_at_the_last_moment_leaves_the_old_one(tmp_path, monkeypatch):
    output = tmp_path / "report"
    write(output, "old")
    rename = pathlib.Path.rename

    def fail_for_the_new_one(self, target):
        if self.suffix == ".tmp":
            assert not output.exists(), "the old one is out of the way"
            raise OSError("disk full")
        return rename(self, target)

    monkeypatch.setattr(pathlib.Path, "rename", fail_for_the_new_one)
    with pytest.raises(OSError, match="disk full"):
        write(output, "new")
    assert (output / "tables" / "runs.csv").read_text() == "old"
    assert names(tmp_path) == ["report"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_report_leaves_the_old_one(tmp_path, error):
    output = tmp_path / "report"
    write(output, "old")

    def fail():
        with folder.replaced(output) as new:
            (new / "index.html").write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert (output / "tables" / "runs.csv").read_text() == "old"
    assert names(tmp_path) == ["report"]


def test_a_killed_report_leaves_the_old_one(tmp_path):
    output = tmp_path / "report"
    write(output, "old")
    program = (
        "import os, pathlib, sys\n"
        "from jaxil.reporting import folder\n"
        "with folder.replaced(pathlib.Path(sys.argv[1])) as new:\n"
        "    (new / 'index.html').write_text('half')\n"
        f"    os.kill(os.getpid(), {int(signal.SIGKILL)})\n"
    )
    command = [sys.executable, "-c", program, str(output)]
    killed = subprocess.run(command, check=False, cwd=ROOT)
    assert killed.returncode == -signal.SIGKILL
    assert (output / "tables" / "runs.csv").read_text() == "old"
    assert folder.problems(output) == []


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "report")
    write(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert names(tmp_path / "report") == ["figures", "index.html", "tables"]


@pytest.mark.parametrize(
    "stranger", ["notes.txt", "figures/photo.jpg", "tables/more/x.csv", "config.json"]
)
def test_files_that_no_report_wrote_are_not_replaced(tmp_path, stranger):
    write(tmp_path / "report", "old")
    path = tmp_path / "report" / stranger
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    (problem,) = folder.problems(tmp_path / "report")
    assert stranger.rsplit("/x", 1)[0] in problem


def test_a_page_that_is_no_report_is_not_replaced(tmp_path):
    (tmp_path / "index.html").write_text("<p>my page</p>")
    (problem,) = folder.problems(tmp_path)
    assert "index.html" in problem


def test_files_and_closed_folders_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    assert "is a file" in folder.problems(tmp_path / "file")[0]
    assert "Not a directory" in folder.problems(tmp_path / "file" / "report")[0]
    assert "cannot be written (/proc: " in folder.problems(pathlib.Path("/proc/x"))[0]
    assert folder.problems(tmp_path / "new" / "report") == []
