"""Imports point down: pure maths never learns about files, flags or simulators."""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parent.parent / "jaxil"

# The folders are the floors; learner and rewarders share one. What lies at the
# package's top is what people type, above them all; `reporting` and `timing` are
# parts of it.
TOP = 4
FLOORS = {"maths": 0, "networks": 1, "learner": 2, "rewarders": 2, "host": 3}
FLOORS |= {"reporting": TOP, "timing": TOP}
PURE = ("maths", "networks", "learner", "rewarders")
HOST_ONLY = {"absl", "ml_collections", "dm_control", "dm_env", "os", "time", "pathlib"}


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


def test_every_folder_is_a_floor():
    found = {path.parent.relative_to(ROOT).parts[0] for path in ROOT.glob("*/*.py")}
    assert found == set(FLOORS)
    assert all(files_of(folder) for folder in FLOORS)


@named(files_of(*PURE))
def test_pure_floors_import_downwards(path):
    floor = FLOORS[path.relative_to(ROOT).parts[0]]
    above = {name for name in own_imports(path.read_text()) if floor_of(name) > floor}
    assert not above, f"{path.name} imports from a higher floor: {sorted(above)}"


@named(files_of(*PURE))
def test_pure_floors_know_no_files_flags_clocks_or_simulators(path):
    impure = packages(path.read_text()) & HOST_ONLY
    assert not impure, f"{path.name} must stay pure; it imports {sorted(impure)}"


@named(files_of("host"))
def test_the_host_knows_only_itself(path):
    # It is handed functions, so it needs neither the floors below nor those above.
    source = path.read_text()
    others = {name for name in own_imports(source) if floor_of(name) != FLOORS["host"]}
    assert not others, f"{path.name} imports {sorted(others)}"
    flags = packages(source) & {"absl", "ml_collections"}
    assert not flags, f"{path.name} takes plain arguments; it imports {sorted(flags)}"


@named(sorted(ROOT.rglob("*.py")))
def test_one_file_knows_the_simulator(path):
    if path != ROOT / "host" / "environment.py":
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
    assert floor_of("jaxil.config") == TOP
    assert floor_of("jaxil.maths.losses.td_target") == 0
