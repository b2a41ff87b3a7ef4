"""The table of methods: what files declare, and methods from outside."""

import ast
import os
import pathlib

import pytest

from jaxil import command, methods
from jaxil import config as jaxil_config
from jaxil.errors import UsageError
from jaxil.presets import tiny
from tests.commands import ROOT, SMALL, call, small_run
from tests.learner.small_learner import make_learner
from tests.processes import run_python
from tests.reporting.run_folders import change_config, write_run
from tests.tiny_agent import make_agent

_DECLARED = {
    path.stem: path
    for path in (ROOT / "jaxil" / "rewarders").glob("*.py")
    if "METHOD = " in path.read_text()
}
each_method = pytest.mark.parametrize("name", sorted(_DECLARED))

# A package of one file, as a user would write it.
_BRIGHT = '''
"""Rewards bright pictures."""

import jax.numpy as jnp

from jaxil import methods
from jaxil.learner.rewarder import Rewarder

METHOD = methods.Method(
    name="bright",
    label="Bright",
    about="the brightness of what it sees",
    sections={
        "brightness": {
            "weight": methods.Field(1.0, "factor on rewards", 0.0, 10.0, positive=True)
        }
    },
    uses_demonstrations=False,
    metrics=("brightness/weight",),
)


def make_rewarder(agent, *, weight):
    def rewards(state, learner, episode, expert_episodes):
        frames = episode.frames[1:].astype(jnp.float32) / 255.0
        return weight * jnp.mean(frames, axis=(1, 2, 3))

    return Rewarder(rewards, summary=lambda state: {"brightness/weight": weight})
'''


# Our own -----------------------------------------------------------------------


def test_every_declaration_is_known_by_the_name_of_its_file():
    assert len(_DECLARED) >= 7
    assert set(methods.known()) >= set(_DECLARED)
    for name in _DECLARED:
        module = methods.load(name, "METHOD")
        assert module == methods.get(name)
        assert module.name == name


@each_method
def test_its_functions_take_every_field_need_each_and_refuse_others(name):
    method = methods.get(name)
    declared = [
        item for section in method.sections.values() for item in section.items()
    ]
    fields = {field: settings.default for field, settings in declared}
    assert len(fields) == len(declared)  # sections are merged into one call

    def make(fields):
        rewarder = methods.load(name, method.make_rewarder)(make_agent(), **fields)
        if method.make_update_step is not None:
            make_step = methods.load(name, method.make_update_step)
            make_step(make_learner(rewarder), **fields)

    make(fields)
    for field in fields:
        with pytest.raises((KeyError, TypeError), match=field):
            make({other: fields[other] for other in fields if other != field})
    with pytest.raises(TypeError, match="no_such_field"):
        make(fields | {"no_such_field": 1})


@each_method
def test_defaults_keep_their_own_rules_and_names_lead_to_fields(name):
    config = jaxil_config.default_config(name, "walker_walk")
    assert jaxil_config.problems(config, ("walker_walk",)) == []
    method = methods.get(name)
    known = jaxil_config.fields(name)
    for variation in method.variations:
        assert variation.plain == known[variation.field].default
    assert isinstance(method.sees_actions, bool) or method.sees_actions in known
    assert method.plays or method.total_updates > 0


@pytest.mark.parametrize("task", ["ball_in_cup_catch", "walker_walk"])
def test_a_method_that_does_not_play_updates_as_often_in_every_preset(task):
    idle = [name for name in _DECLARED if not methods.get(name).plays]
    assert idle == ["bc"]
    for config in (
        jaxil_config.default_config("bc", task),
        tiny.get_config(f"bc,{task}"),
        command.read_config([f"--config=tiny:pdac,{task}", "--config.method=bc"]),
    ):
        num_steps = config.total_frames / config.action_repeat
        updates_per_step = config.updates_per_step / config.update_every_steps
        assert num_steps * updates_per_step == 55_000  # of the reference


@pytest.mark.parametrize("task", ["walker_walk", "ball_in_cup_catch"])
def test_a_method_that_plays_trains_as_long_in_place_of_one_that_does_not(task):
    changed = command.read_config([f"--config=bc:{task}", "--config.method=pdac"])
    assert changed.to_dict() == jaxil_config.default_config("pdac", task).to_dict()


def test_labels_ranks_and_colours_are_unique():
    for attribute in ("label", "rank", "colour"):
        values = [getattr(methods.get(name), attribute) for name in _DECLARED]
        assert len(set(values)) == len(values)
    ranks = [method.rank for method in methods.known().values()]
    assert ranks == sorted(ranks)


def test_declarations_are_read_without_jax():
    printed = run_python(
        "import sys\n"
        "from jaxil import config, methods\n"
        "[config.default_config(name) for name in methods.known()]\n"
        "print(len(methods.known()), 'jax' in sys.modules)\n"
    )
    assert printed.split() == [str(len(methods.known())), "False"]


# From outside ------------------------------------------------------------------


@pytest.fixture
def package(tmp_path, monkeypatch) -> pathlib.Path:
    """A folder that Python finds, with the one file of a method in it."""
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "my_method.py").write_text(_BRIGHT)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(folder), str(ROOT))))
    return folder


def test_a_method_from_outside_is_swept_and_reported(package, tmp_path):
    """No line of jaxil knows it, yet sweep, training and report do what they do."""
    del package
    swept = call(
        "sweep",
        *("--methods=my_method:METHOD", "--preset=tiny", "--tasks=ball_in_cup_catch"),
        *("--seeds=1", "--workers=1", "--cluster=local", f"--workdir={tmp_path}"),
        *(*SMALL, "--config.brightness.weight=0.5", "--config.total_frames=1000"),
    )
    assert swept.returncode == 0, swept.stdout + swept.stderr
    (workdir,) = tmp_path.glob("ball_in_cup_catch/*/seed0")
    header, first, *_ = (workdir / "train.csv").read_text().splitlines()
    row = dict(zip(header.split(","), first.split(",")))
    assert float(row["brightness/weight"]) == 0.5
    # 100 agent steps of pictures that are neither black nor white.
    assert 0.0 < float(row["imitation_return"]) < 50.0
    assert list(workdir.glob("checkpoints/frame_*"))

    output = tmp_path / "report"
    trust = "--trust=my_method:METHOD"
    reported = call("report", str(workdir), trust, f"--output={output}")
    assert reported.returncode == 0, reported.stderr
    assert "Bright" in (output / "index.html").read_text()


def test_its_own_fields_are_checked_like_any_other(package, tmp_path):
    del package
    finished = call(
        "launch",
        *small_run("zero", tmp_path / "run"),
        "--config.method=my_method:METHOD",
        "--config.brightness.weight=-1",
        "--config.brightness.wait=2",
    )
    assert finished.returncode == 2
    assert "Traceback" not in finished.stderr
    weight = "brightness.weight=-1.0 must lie in (0.0, 10.0]; factor on rewards"
    assert weight in finished.stderr
    assert "brightness.wait" in finished.stderr
    assert not (tmp_path / "run").exists()


def test_installed_packages_name_methods_by_entry_points(package):
    information = package / "my_method-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Name: my-method\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(
        # The second has a name that is taken: ours stays.
        "[jaxil.methods]\nbright = my_method:METHOD\npdac = my_method:METHOD\n"
    )
    printed = run_python(
        "import sys\n"
        "from jaxil import config, methods\n"
        "bright = methods.known()['bright']\n"
        "config = config.default_config('bright', 'walker_walk')\n"
        "print((bright.name, bright.label, config.method, config.brightness.weight,\n"
        "       methods.get('pdac').label, 'jax' in sys.modules))\n"
    )
    expected = ("bright", "Bright", "bright", 1.0, "P-DAC", False)
    assert ast.literal_eval(printed) == expected


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ("gail", ("method='gail'", "pdac", "package.module:METHOD")),
        ("no_such_package:METHOD", ("no_such_package", "PYTHONPATH")),
        ("no.such.package:METHOD", ("no.such.package", "PYTHONPATH")),
        ("jaxil.rewarders.matching:METHOD", ("is not declared", "METHOD")),
        ("jaxil.rewarders.pdac:make_rewarder", ("is not declared", "make_rewarder")),
    ],
)
def test_what_names_no_method_is_refused(reference, words):
    with pytest.raises(UsageError) as caught:
        methods.get(reference)
    for word in words:
        assert word in str(caught.value)


# Named by files ----------------------------------------------------------------

# A package that must not be imported, and leaves a trace if it is.
_TRAP = """
import pathlib
pathlib.Path(__file__).with_name("sprung").touch()
"""


@pytest.fixture
def trap(package, tmp_path) -> pathlib.Path:
    """A run's folder whose config names a module in that package."""
    (package / "trap").mkdir()
    (package / "trap" / "__init__.py").write_text(_TRAP)
    (package / "trap" / "inner.py").write_text(_BRIGHT)
    folder = write_run(tmp_path / "run", "zero", "walker_walk", 0, {1000: 10})
    change_config(folder, {"method": "trap.inner:METHOD"})
    return folder


def _was_sprung(package) -> bool:
    return (package / "trap" / "sprung").exists()


@pytest.mark.parametrize("named", ["nothing.at_all:METHOD", "jaxil.rewarders.pdac"])
def test_what_is_trusted_exists(named):
    ended = call("report", "runs", f"--trust=jaxil.rewarders.pdac:METHOD,{named}")
    assert ended.returncode == 2
    assert f"--trust='{named}' is not the package.module:name" in ended.stderr
    assert "pdac:METHOD' is not" not in ended.stderr


def test_reading_a_folder_imports_no_module_that_it_names(package, trap):
    printed = run_python(
        "import pathlib\n"
        "from jaxil.errors import UsageError\n"
        "from jaxil.reporting import runs\n"
        "from jaxil.training import workdir\n"
        f"folder = pathlib.Path({str(trap)!r})\n"
        "print(runs.read(folder).remarks)\n"
        "print(runs.read(folder).variant.label)\n"
        "try: workdir.read_config(folder)\n"
        "except UsageError as error: print(error)\n"
    )
    remarks, label, refusal = printed.splitlines()
    assert "'trap.inner:METHOD' is code that only its folder names" in remarks
    assert label == "trap.inner:METHOD"
    assert "method='trap.inner:METHOD' is code from outside" in refusal
    assert "--trust=trap.inner:METHOD" in refusal
    assert not _was_sprung(package)


def test_a_command_imports_a_module_that_the_user_names(package, trap, tmp_path):
    output = tmp_path / "report"
    finished = call("evaluate", f"--workdir={trap}")
    assert finished.returncode == 2
    assert "is code from outside" in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not _was_sprung(package)
    words = (str(trap), "--trust", "trap.inner:METHOD", f"--output={output}")
    finished = call("report", *words)
    assert finished.returncode == 0, finished.stderr
    assert "Bright" in (output / "index.html").read_text()
    assert _was_sprung(package)


def test_a_broken_installed_method_is_named_and_the_others_work(package):
    information = package / "broken-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Name: broken\nVersion: 1.0\n")
    (package / "broken.py").write_text("import sys\nMETHOD = sys.exit(3)\n")
    (information / "entry_points.txt").write_text(
        "[jaxil.methods]\n"
        "gone = no_such_module:METHOD\n"
        "broken = broken:METHOD\n"
        "bright = my_method:METHOD\n"
    )
    printed = run_python(
        "import contextlib, io\n"
        "from jaxil import methods\n"
        "from jaxil.errors import UsageError\n"
        "with contextlib.redirect_stderr(io.StringIO()) as said:\n"
        "    names = [*methods.known(), *methods.known()]\n"
        "    try: methods.get('broken')\n"
        "    except UsageError as error: print(error, file=said)\n"
        "print((names, said.getvalue()))\n"
    )
    names, said = ast.literal_eval(printed)
    assert names.count("bright") == names.count("pdac") == 2
    assert not {"gone", "broken"} & set(names)
    left_out, also_left_out, refused = said.splitlines()
    assert "'gone' is left out" in left_out
    assert "'no_such_module'" in left_out
    assert "'broken' is left out" in also_left_out
    assert "cannot be loaded: SystemExit: 3 (broken.py, line " in refused
