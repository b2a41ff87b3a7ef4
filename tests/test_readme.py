"""What README and docs tell people to type is understood; the docs can be built."""

import importlib
import importlib.util
import os
import re
import shlex
import subprocess
import sys

import pytest

from jaxil import __main__, command
from tests.commands import ROOT
from tests.demonstrations import foreign_files
from tests.reporting.run_folders import write_run

_BLOCK = re.compile(r"```(\w+)\n(.*?)```", re.DOTALL)
README = (ROOT / "README.md").read_text()
PAGES = [path.read_text() for path in sorted((ROOT / "docs").glob("*.md"))]
TEXT = "\n".join([README, *PAGES])


def _blocks(language: str) -> list[str]:
    return [text for name, text in _BLOCK.findall(TEXT) if name == language]


def _typed() -> list[str]:
    lines = "\n".join(_blocks("sh")).replace("\\\n", " ").splitlines()
    return [" ".join(line.split()) for line in lines if line.strip()]


# Run as they are typed, in a folder that has what they read. tests/test_adoption.py
# runs others; the rest take minutes, or need what is the reader's own, my_...
_CHEAP = re.compile(
    r"jaxil (doctor|report runs/main|collect --inspect|sweep .*--dry_run)"
)
_RUN = sorted({line.split(" #")[0].strip() for line in _typed() if _CHEAP.match(line)})
_PARSED = [line for line in _typed() if not _CHEAP.match(line) and "my_" not in line]


class _Understood(Exception):
    pass


@pytest.fixture(name="only_parsed")
def _only_parsed(monkeypatch):
    """Ends each command when its command line has been read without a fault."""
    parse = command.parse

    def parse_and_end(argv, description, define, check=None):
        del check  # whether folders and Slurm are there
        parse(argv, description, define)
        raise _Understood

    monkeypatch.setattr(command, "parse", parse_and_end)
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize("line", _RUN)
def test_a_cheap_command_does_what_it_says(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    foreign_files.write_video(tmp_path / "my_video.mp4", 0)
    write_run(tmp_path / "runs" / "main" / "1", "pdac", "walker_walk", 0, {1000: 10})
    words = shlex.split(line, comments=True)
    assert not __main__.main(words)
    outputs = [word.removeprefix("--output=") for word in words if "--output" in word]
    assert all(any((tmp_path / name).iterdir()) for name in outputs)


def test_cheap_commands_are_still_in_the_text():
    assert len(_RUN) == 4


@pytest.mark.parametrize("line", _PARSED)
def test_a_command_is_understood(line, only_parsed):
    words = [w for w in shlex.split(line, comments=True) if w not in ("[", "]")]
    program = words[0].rpartition("/")[2]
    if program == "bash":
        assert (ROOT / words[1]).is_file()
    elif program == "docker":
        assert (ROOT / "Dockerfile").is_file()
    elif program in ("pip", "python3.11", "wandb"):
        assert not re.search(r"jaxil\[", line)  # no index has it
    else:
        assert program == "jaxil"
        with pytest.raises(_Understood):
            __main__.main(words)


@pytest.mark.parametrize("text", _blocks("python"))
def test_an_example_names_what_exists(text):
    compile(text, "README", "exec")
    for module, name in re.findall(r"from (jaxil[.\w]*) import (\w+)", text):
        owner = importlib.import_module(module)
        assert hasattr(owner, name) or importlib.util.find_spec(f"{module}.{name}")
    for module, name in re.findall(r"\b(jaxil)\.(\w+)\(", text):
        assert hasattr(importlib.import_module(module), name)


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "launch/results").glob("*.md"))]
)
def test_files_and_headings_that_are_linked_exist(page):
    links = re.findall(r"\]\((?!http)([^)#]*)#?([^)]*)\)", page.read_text())
    assert links or page.name == "reliability.md"
    for path, anchor in links:
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in _anchors(target), f"{path}#{anchor}"


def _anchors(page):
    """Returns the names that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.*)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_the_docs_are_built_without_a_warning(tmp_path):
    finished = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300.0,
    )
    assert finished.returncode == 0, finished.stderr
    assert "load_policy" in (tmp_path / "api" / "index.html").read_text()
