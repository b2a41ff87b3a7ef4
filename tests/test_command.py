"""The command line: words in, a config out, and all faults in one message."""

import pytest
from absl import flags

from jaxil import command, launch, methods
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


def test_the_sections_follow_the_method():
    words = ("--config.sinkhorn.epsilon=0.02", "--config.method=psil")
    config = _parse(PDAC, *words).config
    assert (config.method, config.task) == ("psil", "walker_walk")
    assert config.sinkhorn.epsilon == 0.02
    assert "discriminator" not in config
    usual = jaxil_config.default_config("psil", "walker_walk")
    usual.sinkhorn.epsilon = 0.02
    assert config.to_dict() == usual.to_dict()


@pytest.mark.parametrize(
    ("text", "value"), [("(32,16)", (32, 16)), ("[8]", (8,)), ("()", ())]
)
def test_lists(text, value):
    config = command.read_config([PDAC, f"--config.encoder.channels={text}"])
    assert config.encoder.channels == value


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
        *(PDAC, "stray", "--bogus=1", "--size=big", "--config.bath_size=8"),
        *("--config.seed=2.5", "--config.encoder.channels=32"),
        *("--config.task=walker_wlak", "--config.batch_size=0"),
    )
    expected = (
        "'stray' is not a flag; flags start with --",
        "flag='--bogus' is unknown",
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
    assert message.startswith("Invalid configuration:\n  - 'stray'")
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
    assert "python -m jaxil.launch" in shown
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
