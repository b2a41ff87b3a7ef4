"""The command line: words in, a config out, and all faults in one message."""

import pytest
from absl import flags

from jaxil import __main__, command, launch, methods
from jaxil import config as jaxil_config
from jaxil.errors import UsageError
from tests.commands import ROOT

PDAC = f"--config={ROOT}/configs/pdac.py:walker_walk"


def _define(values):
    command.define_config(values)
    flags.DEFINE_boolean("start", True, "a switch", flag_values=values)
    flags.DEFINE_integer("size", 3, "a number", flag_values=values)


def _parse(*words):
    return command.parse(["command", *words], "", _define)


def _faults(*words):
    with pytest.raises(UsageError) as raised:
        _parse(*words)
    return [str(fault) for fault in raised.value.faults]


def test_a_value_may_follow_after_a_space():
    flag, _, file = PDAC.partition("=")
    values = _parse(flag, file, "--config.seed", "7", "--size", "4")
    assert (values.config.method, values.config.seed, values.size) == ("pdac", 7, 4)
    assert _parse(PDAC, "--config.noise_clip", "1e-1").config.noise_clip == 0.1
    (fault,) = _faults(PDAC, "--config.seed", "--size=4")
    assert fault == "seed='' has the wrong type: expected a whole number"


def test_a_tilde_in_a_value_is_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "own.py").write_text("from jaxil.presets.tiny import get_config")
    source = "--config.demonstrations.source=~/a.npz"
    config = command.read_config(command.joined(["--config=~/own.py", source]))
    assert config.demonstrations.source == str(tmp_path / "a.npz")


def test_the_sections_follow_the_method():
    words = ("--config.sinkhorn.epsilon=0.02", "--config.method=psil")
    config = _parse(PDAC, *words).config
    assert (config.method, config.task) == ("psil", "walker_walk")
    assert config.sinkhorn.epsilon == 0.02
    assert "discriminator" not in config
    usual = jaxil_config.default_config("psil", "walker_walk")
    usual.sinkhorn.epsilon = 0.02
    assert config.to_dict() == usual.to_dict()


def test_a_section_of_the_same_name_takes_the_new_methods_defaults():
    """What the preset changed stays; the former method's own defaults do not."""
    changed = command.read_config([PDAC, "--config.method=laifo"])
    usual = jaxil_config.default_config("laifo", "walker_walk")
    assert changed.to_dict() == usual.to_dict()
    assert changed.discriminator.learning_rate != (
        jaxil_config.default_config("pdac").discriminator.learning_rate
    )
    small = command.read_config(
        ["--config=tiny:pdac,walker_walk", "--config.method=laifo"]
    )
    assert small.discriminator.hidden_dim == 256


@pytest.mark.parametrize(
    ("text", "value"), [("(32,16)", (32, 16)), ("[8]", (8,)), ("()", ())]
)
def test_lists(text, value):
    config = command.read_config([PDAC, f"--config.encoder.channels={text}"])
    assert config.encoder.channels == value


@pytest.mark.parametrize("text", ["32", "(32,", "{{}}"])
def test_what_is_no_list_is_one_sentence(text):
    (fault,) = _faults(PDAC, f"--config.encoder.channels={text}")
    assert f"{text!r} has the wrong type: expected a list in brackets" in fault


@pytest.mark.parametrize(
    ("lines", "lacking"),
    [
        ("return ml_collections.ConfigDict({'seed': 3})", "method, task, observation"),
        (
            "config = default_config('pdac', 'walker_walk')\n"
            "    config.method = 'psil'\n"
            "    return config",
            "sinkhorn.cost, sinkhorn.alignment, sinkhorn.epsilon",
        ),
    ],
)
def test_a_file_whose_config_lacks_fields_is_one_sentence(lines, lacking, tmp_path):
    (tmp_path / "own.py").write_text(
        "import ml_collections\n"
        "from jaxil.config import default_config\n"
        f"def get_config():\n    {lines}\n"
    )
    (fault,) = _faults(f"--config={tmp_path}/own.py")
    assert f"leaves out {lacking}; start from" in fault


@pytest.mark.parametrize("field", ["method", "task", "seed", "encoder.channels"])
def test_a_file_with_none_in_a_field_is_one_sentence(field, tmp_path):
    (tmp_path / "own.py").write_text(
        "from jaxil.config import default_config\n"
        "def get_config():\n"
        "    config = default_config('pdac', 'walker_walk')\n"
        f"    config.{field} = None\n"
        "    return config\n"
    )
    flags = (f"--config={tmp_path}/own.py", "--config.seed=3", "--config.method=psil")
    (fault,) = _faults(*flags)
    assert f"{field}=None must be" in fault


def test_fields_that_a_file_misspells_are_named(tmp_path):
    (tmp_path / "own.py").write_text(
        "from jaxil.config import default_config\n"
        "def get_config():\n"
        "    config = default_config('pdac', 'walker_walk')\n"
        "    config.bath_size = 8\n"
        "    config.discriminator.hiden_dim = 8\n"
        "    return config\n"
    )
    first, second = _faults(f"--config={tmp_path}/own.py")
    assert "'bath_size' is unknown; did you mean: batch_size" in first
    assert "'discriminator.hiden_dim' is unknown" in second


@pytest.mark.parametrize(
    ("lines", "shown"),
    [
        ("    raise KeyError('gamma')", "KeyError: 'gamma' (own.py, line 6)"),
        ("    return", "does not return a ConfigDict"),
        ("    return (", "SyntaxError: '(' was never closed (own.py, line 6)"),
    ],
)
def test_a_file_that_fails_says_where(lines, shown, tmp_path):
    """The dataclass needs its module to be known to Python, as any import does."""
    (tmp_path / "own.py").write_text(
        "from __future__ import annotations\nimport dataclasses\n"
        f"@dataclasses.dataclass\nclass Size: side: int\ndef get_config():\n{lines}\n"
    )
    (fault,) = _faults(f"--config={tmp_path}/own.py")
    assert shown in fault


def test_switches():
    assert _parse(PDAC, "--nostart").start is False
    assert _parse(PDAC, "--start=false").start is False
    values = _parse("--start", PDAC, "--config.replay_on_device=True")
    assert values.start is True
    assert values.config.replay_on_device is True
    faults = _faults(PDAC, "--start=maybe", "--config.replay_on_device=maybe")
    assert "--start is wrong" in faults[0]
    assert "expected True or False" in faults[1]


def test_all_faults_are_one_message():
    told = _faults(
        *(PDAC, "stray", "-bogus=1", "--size=big", "--config.bath_size=8"),
        *("--config.seed=2.5", "--config.encoder.channels=32"),
        *("--config.task=walker_wlak", "--config.batch_size=0"),
    )
    expected = (
        "'stray' is not a flag; flags start with --",
        "flag='-bogus' is unknown",
        "--size is wrong",
        "field='bath_size' is unknown; did you mean: batch_size",
        "seed='2.5' has the wrong type: expected a whole number",
        "encoder.channels='32' has the wrong type: expected a list in brackets",
        "task='walker_wlak' is unknown; did you mean: walker_walk",
        "batch_size=0 must lie in [1, 65536]; 256 in the paper",
    )
    for fault, words in zip(told[: len(expected)], expected, strict=True):
        assert words in fault
    # batch_size is also below that of the discriminator, which is another fault.
    message = str(UsageError(told))
    assert message.startswith("Several faults:\n  - 'stray'")
    assert message.count("\n") == len(told)


@pytest.mark.parametrize("method", ["gail", "nowhere:METHOD", "os.path:METHOD", ":"])
def test_a_bad_method_is_one_sentence(method):
    (fault,) = _faults(PDAC, f"--config.method={method}")
    assert fault.startswith(f"method={method!r} ")
    with pytest.raises(UsageError, match="method="):
        command.read_config([PDAC, f"--config.method={method}"])


def test_a_method_whose_file_is_no_python_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    for name, text in (("broken", "METHOD = ("), ("other", "METHOD = 3")):
        (tmp_path / f"{name}.py").write_text(text)
        (fault,) = _faults(PDAC, f"--config.method={name}:METHOD")
        assert fault.startswith(f"method='{name}:METHOD' ")


def test_help_lists_every_field_with_default_and_range(capsys):
    with pytest.raises(SystemExit) as ended:
        launch.main(["launch", "--help"])
    assert not ended.value.code
    shown = capsys.readouterr().out
    lines = [line.strip() for line in shown.splitlines()]
    assert "jaxil train --config=" in shown
    for method in methods.known():
        assert any(line.startswith(f"of {method} (") for line in lines) == bool(
            methods.get(method).sections
        )
        for name, field in jaxil_config.fields(method).items():
            described = [line for line in lines if line.startswith(f"{name}: ")]
            assert described, name
            wanted = [f"default: {field.default!r}", *field.choices]
            if field.low is not None:
                wanted += [f"{field.low:g} to {field.high:g}"]
            assert any(all(w in line for w in wanted) for line in described), name


@pytest.mark.parametrize("file", sorted((ROOT / "configs").glob("*.py")), ids=str)
def test_each_file_of_configs_is_a_preset_of_the_package(file):
    argument = "psil,cheetah_run" if file.stem == "tiny" else "cheetah_run"
    of_file, of_preset = (
        command.read_config([f"--config={name}:{argument}"])
        for name in (file, file.stem)
    )
    assert of_file.to_dict() == of_preset.to_dict()


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("tiny:pdac", "--config='tiny:pdac' lacks the task; write METHOD,TASK"),
        ("tiny:gail,walker_walk", "method='gail' is unknown"),
        (
            "pdca:walker_walk",
            "--config='pdca' is unknown; choose one of: expert, tiny, pdac",
        ),
    ],
)
def test_a_bad_preset_is_one_sentence(value, expected):
    (fault,) = _faults(f"--config={value}")
    assert expected in fault


def test_one_command_leads_to_all(capsys):
    assert __main__.main(["jaxil"]) == 0
    listed = capsys.readouterr().out
    for word, tells in (("train", "--config"), ("sweep", "--methods")):
        assert f"  {word} " in listed
        with pytest.raises(SystemExit) as ended:
            __main__.main(["jaxil", word, "--help"])
        assert not ended.value.code
        shown = capsys.readouterr().out
        assert f"  {tells}: " in shown
        flags_shown = [s.split(":")[0] for s in shown.splitlines() if "  --" in s]
        assert len(flags_shown) == len(set(flags_shown))
    with pytest.raises(UsageError, match="command='trian' is unknown"):
        __main__.main(["jaxil", "trian"])
