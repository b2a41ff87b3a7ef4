"""Imports point down: pure maths never learns of files or flags. Files are short."""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parent.parent / "jaxil"

# Rooms and files of the package by floor: each imports from floors below its own, or
# from itself. What is not named here is a command, on top of all.
FLOORS = {
    "errors": -1,
    **dict.fromkeys(("declarations", "outside"), 0),
    **dict.fromkeys(("methods", "maths", "machine", "files"), 1),
    **dict.fromkeys(("native", "replay"), 2),
    **dict.fromkeys(("networks", "environments"), 3),
    **dict.fromkeys(("learner", "demonstrations"), 4),
    "rewarders": 5,
    "config": 6,
    "presets": 7,
    "reporting": 7,
    "training": 8,
    "command": 9,  # checks a config as training does
    "train": 9,
    "timing": 10,
    "record": 10,
    "sweeps": 10,
}
TOP = 11
PURE = ("maths", "networks", "learner", "rewarders")
HOST_ONLY = {"absl", "ml_collections", "dm_control", "dm_env", "os", "time", "pathlib"}
# Rooms that are handed plain arguments and functions.
HOST = ("machine", "files", "replay", "environments", "demonstrations")


def imported_modules(source: str) -> set[str]:
    """Returns dotted names of all that a file imports, also inside functions."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            names |= {f"{module}.{alias.name}" for alias in node.names}
    return names


def packages(source: str) -> set[str]:
    """Returns the outermost name of each import."""
    return {name.split(".")[0] for name in imported_modules(source)}


def floor_of(module: str) -> int:
    """Returns the floor of a dotted name within the package."""
    parts = module.split(".")
    return FLOORS.get(parts[1], TOP) if len(parts) > 1 else TOP


def own_imports(source: str) -> set[str]:
    return {name for name in imported_modules(source) if name.split(".")[0] == "jaxil"}


def files_of(*folders: str) -> list[pathlib.Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def named(paths: list[pathlib.Path]):
    return pytest.mark.parametrize(
        "path", paths, ids=lambda path: path.relative_to(ROOT).as_posix()
    )


def test_every_folder_has_a_floor():
    found = {path.parent.relative_to(ROOT).parts[0] for path in ROOT.glob("*/*.py")}
    assert found <= set(FLOORS)


@named(sorted(ROOT.rglob("*.py")))
def test_imports_point_down(path):
    room = path.relative_to(ROOT).with_suffix("").parts[0]
    floor = FLOORS.get(room, TOP)
    above = {
        name
        for name in own_imports(path.read_text())
        if floor_of(name) >= floor and name.split(".")[1] != room
    }
    assert not above or floor == TOP, f"{path} imports upwards: {sorted(above)}"


@named(files_of(*PURE))
def test_pure_floors_know_no_files_flags_clocks_or_simulators(path):
    impure = packages(path.read_text()) & HOST_ONLY
    assert not impure, f"{path.name} must stay pure; it imports {sorted(impure)}"


@named(files_of(*HOST))
def test_host_rooms_know_neither_flags_nor_learners(path):
    source = path.read_text()
    flags = packages(source) & {"absl", "ml_collections"}
    assert not flags, f"{path.name} takes plain arguments; it imports {sorted(flags)}"
    pure = ("networks", "learner", "rewarders")
    learners = {n for n in own_imports(source) if n.split(".")[1] in pure}
    assert not learners, f"{path.name} imports {sorted(learners)}"


@named(sorted(ROOT.rglob("*.py")))
def test_one_file_knows_the_simulator(path):
    if path != ROOT / "environments" / "suite.py":
        assert "dm_control" not in packages(path.read_text())


@named(sorted(ROOT.rglob("*.py")))
def test_imports_are_absolute(path):
    # A relative one would slip past the rules above.
    assert "" not in packages(path.read_text())


def test_the_reader_of_imports_sees_them_all():
    source = (
        "import os.path as p, jax\n"
        "from jaxil import config\n"
        "def f():\n"
        "    from dm_control.suite import cartpole\n"
        "    from .. import host\n"
    )
    assert packages(source) == {"os", "jax", "jaxil", "dm_control", ""}
    assert own_imports(source) == {"jaxil.config"}
    assert floor_of("jaxil.launch") == TOP
    assert floor_of("jaxil.maths.losses.td_target") == 1


def test_files_are_short():
    # Only tables of data may be longer, and none is written in these languages.
    project = ROOT.parent
    languages = {".py", ".sh", ".c", ".h", ".js", ".css", ".jinja"}
    lengths = {
        path.relative_to(project).as_posix(): len(path.read_text().splitlines())
        for folder in ("jaxil", "tests", "configs", "launch")
        for path in (project / folder).rglob("*")
        if path.suffix in languages
    }
    assert len(lengths) > 200
    assert {path: length for path, length in lengths.items() if length > 350} == {}
