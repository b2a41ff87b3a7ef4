"""Methods from outside whose declaration and functions do not fit."""

import os
from typing import Any

import pytest

from jaxil import config as jaxil_config
from jaxil import presets
from jaxil.errors import UsageError
from jaxil.presets import tiny
from jaxil.training import agent
from tests.commands import ROOT, run

_METHOD = """
import jax.numpy as jnp

from jaxil import methods
from jaxil.learner.rewarder import Rewarder

METHOD = methods.Method(
    name="flat",
    label="Flat",
    about="the same reward always",
    sections={"flat": {"weight": methods.Field(1.0, "each reward", 1.0)}},
    uses_demonstrations=False,
)


def make_rewarder(agent, *, weight):
    return Rewarder(lambda s, l, episode, e: jnp.full(len(episode.actions), weight))
"""


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes a method into a folder that Python finds; returns its name."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(folder), str(ROOT))))

    def write(module, old="", new=""):
        (folder / f"{module}.py").write_text(_METHOD.replace(old, new))
        information = folder / f"{module}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Name: {module}\nVersion: 1.0\n")
        points = f"[jaxil.methods]\nflat = {module}:METHOD\n"
        (information / "entry_points.txt").write_text(points)
        return f"{module}:METHOD"

    return write


def test_a_range_may_have_one_end(write):
    write("half_open")
    helped = run("__main__", "train", "--help")
    assert helped.returncode == 0, helped.stderr
    assert "each reward (default: 1.0; at least 1)" in helped.stdout
    low = run("launch", "--config=flat:walker_walk", "--config.flat.weight=0")
    assert low.returncode == 2
    assert "flat.weight=0.0 must lie in [1.0, inf]; each reward" in low.stderr


def test_its_module_is_a_preset(write):
    name = write("named")
    config = presets.get_config("named", "METHOD:walker_walk")
    assert config == jaxil_config.default_config(name, "walker_walk")
    assert presets.get_config("named", "METHOD") == config
    with pytest.raises(UsageError, match="'nmed' is unknown; choose one of"):
        presets.get_config("nmed", "gymnasium:Hopper-v5")


def test_a_file_that_cannot_be_read_says_where(write):
    name = write("open_ended", "1.0)}}", "1.0)}")
    with pytest.raises(UsageError, match=r"SyntaxError.*\(open_ended.py, line \d+\)"):
        presets.get_config("tiny", f"{name},walker_walk")


def test_all_faults_of_a_declaration_are_one_message(write):
    old = 'sections={"flat": {"weight": methods.Field(1.0, "each reward", 1.0)}},'
    new = """sections={
        "other": {"weight": methods.Field(1.0, ""), "my-rate": methods.Field(1, "")},
        "flat": {"weight": methods.Field(1.0, ""), "sizes": methods.Field([8], "")},
        "bare": {"rate": 0.1},
        "far": {"away": methods.Field(3, "", 0, 2), "name": methods.Field("", "", 0)},
        "tied": {"rate": methods.Field(1.0, "", at_most=["batch_size"])},
    },
    sees_actions="flat.sight",
    metrics=("mean", "critic/own", "flat/mean", "flat/mean"),"""
    with pytest.raises(UsageError) as refused:
        jaxil_config.default_config(write("faulty", old, new), "walker_walk")
    faults = [str(fault) for fault in refused.value.faults]
    words = [
        "other.my-rate; use names as Python's variables",
        "'weight' in both 'other' and 'flat'",
        "flat.sizes with the default [8]",
        "sections['bare']={'rate': 0.1}; give a dict of Field",
        "far.away=3 must lie in [0, 2]",
        "far.name with a range, which only numbers have",
        "tied.rate with at_most=['batch_size']; give a field's name",
        "sees_actions='flat.sight', which is none of its fields",
        "metric 'mean'; write GROUP/NAME",
        "metric 'critic/own'",
        "metric 'flat/mean' twice",
    ]
    assert len(faults) == len(words), faults
    for fault, word in zip(faults, words, strict=True):
        assert word in fault
    text = write("texts", "uses_demonstrations", 'metrics=("x/y"),uses_demonstrations')
    with pytest.raises(UsageError, match="metrics='x/y'; give a tuple"):
        jaxil_config.default_config(text, "walker_walk")
    none = write("none", old, "sections=None,")
    with pytest.raises(UsageError, match="sections=None; give a dict of dicts"):
        jaxil_config.default_config(none, "walker_walk")
    taken = write("takes", old, 'sections={"encoder": {}, "own": {}, "seed": {}},')
    with pytest.raises(UsageError, match=r"every config has \(encoder, seed\)"):
        jaxil_config.default_config(taken, "walker_walk")


def test_a_field_may_be_bounded_by_one_of_every_config(write):
    old = 'methods.Field(1.0, "each reward", 1.0)'
    new = 'methods.Field(1.0, "each reward", 1.0, at_most="num_steps")'
    method = write("bounded", old, new)
    config = jaxil_config.default_config(method, "cartpole_swingup")
    config.flat.weight = 3.0
    assert not jaxil_config.problems(config, ("cartpole_swingup",))
    config.flat.weight = 4.0
    (fault,) = jaxil_config.problems(config, ("cartpole_swingup",))
    assert str(fault) == "flat.weight=4.0 is above num_steps=3; use at most 3"
    for limit in ("num_stpes", "camera"):
        wrong = write(f"bounded_by_{limit}", old, new.replace("num_steps", limit))
        with pytest.raises(UsageError, match=f"'{limit}', which is no number"):
            jaxil_config.default_config(wrong, "cartpole_swingup")


def test_a_section_called_discriminator_has_no_rule_of_jaxils(write):
    old = '"flat": {"weight": methods.Field(1.0, "each reward", 1.0)}'
    new = old.replace("flat", "discriminator").replace(
        "}", ', "batch_size": methods.Field(512, "own")}'
    )
    method = write("judged", old, new)
    config = jaxil_config.default_config(method, "cartpole_swingup")
    assert not jaxil_config.problems(config, ("cartpole_swingup",))


def test_what_a_report_reads_of_a_declaration_is_checked_at_the_start(write):
    old = """sections={"flat": {"weight": methods.Field(1.0, "each reward", 1.0)}},"""
    new = """sections={"flat": {
        "weight": methods.Field(1.0, "each reward", 1.0),
        "form": methods.Field("a", "", choices=("a", "b")),
        "other": methods.Field("a", "", choices="ab"),
    }},
    rank="first",
    colour="pinkish",
    variations=(
        methods.Variation("flat.form", "a", "b"),
        methods.Variation("flat.weight", 1.0, "weight {}"),
        methods.Variation("flat.weight", 1.0, "heavy"),
        methods.Variation("flat.weight", 1.0, "{weight}"),
        methods.Variation("flat.none", 1.0, "{}"),
    ),"""
    with pytest.raises(UsageError) as refused:
        jaxil_config.default_config(write("shown", old, new), "walker_walk")
    words = [
        "rank='first'; give a number",
        "colour='pinkish'; write #rrggbb",
        "flat.other with choices='ab'; give a tuple",
        "flat.weight called 'heavy', which would name different values alike",
        "flat.weight called '{weight}'; write {} for a value",
        "a variation of 'flat.none', which is none of its fields",
    ]
    faults = [str(fault) for fault in refused.value.faults]
    assert len(faults) == len(words), faults
    for fault, word in zip(faults, words, strict=True):
        assert word in fault
    bare = write("bare", old, """variations=methods.Variation("a.b", 1, "{}"),""")
    with pytest.raises(UsageError, match="give a tuple of Variation"):
        jaxil_config.default_config(bare, "walker_walk")


def test_the_small_preset_sets_only_declared_fields(write):
    old = '"flat": {"weight": methods.Field(1.0, "each reward", 1.0)}'
    new = '"discriminator": {"hidden_dim": methods.Field(333, "width", 1)}'
    config = tiny.get_config(f"{write('sectioned', old, new)},walker_walk")
    assert config.discriminator.to_dict() == {"hidden_dim": 256}


@pytest.mark.parametrize(
    ("module", "old", "new", "message"),
    [
        ("misnamed", "def make_rewarder", "def make_reward", "has no `make_rewarder`"),
        ("forgetful", "*, weight", "*, wait", "not take its fields: .*'wait'.*weight"),
        ("silent", "return Rewarder", "Rewarder", "returns NoneType; return a Rewa"),
    ],
)
def test_a_function_that_does_not_fit_its_declaration_is_named(
    write, module, old, new, message
):
    config = jaxil_config.default_config(write(module, old, new), "walker_walk")
    networks: Any = None  # it never comes to use them
    with pytest.raises(UsageError, match=message):
        agent.make_rewarder(config, networks)
