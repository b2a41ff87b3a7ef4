"""What all commands share: flags in, one message and an exit status out.

Exit status: 0 done; 2 usage error, with one message that names every fault; 130
interrupted; 1 otherwise.
"""

import ast
import importlib.machinery
import importlib.util
import io
import os
import pathlib
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import ml_collections
from absl import flags

from jaxil import config as jaxil_config
from jaxil import declarations, methods, outside, presets
from jaxil.config import Config
from jaxil.errors import Fault, RunFailed, UsageError, collecting, raised, unknown_name
from jaxil.files.settings import flat

Define = Callable[[flags.FlagValues], None]
Check = Callable[[flags.FlagValues], Iterable[Fault | str]]

_CONFIG, _TRUST = "config", "trust"


def parse(
    argv: list[str], description: str, define: Define, check: Check = lambda values: ()
) -> flags.FlagValues:
    """Reads the command line, collecting every fault before it gives up.

    `define` adds the command's flags, see `define_config`; `check` returns the faults
    of their values. `--help` begins with the description.

    Raises:
      UsageError: names all flags and config fields that are wrong.
      SystemExit: status 0, after `--help`.
    """
    values = flags.FlagValues()
    define(values)
    if any(word in ("--help", "-h", "-help", "--helpfull") for word in argv[1:]):
        print(f"{description.strip()}\n\n{_help(values)}")
        raise SystemExit(0)
    faults: list[Fault | str] = []
    config_words = []
    for word in joined(argv[1:], values):
        name = _name(word)
        if not word.startswith("-"):
            faults.append(Fault(repr(word), "is not a flag", "flags start with --"))
        elif _CONFIG in values and name.split(".")[0] == _CONFIG:
            config_words.append(word)
        elif not {name, name.removeprefix("no")} & set(values):
            known = tuple(f"--{flag}" for flag in values)
            faults.append(unknown_name("flag", word.partition("=")[0], known))
        else:
            try:
                values([argv[0], word])
            except (flags.Error, ValueError) as error:  # the latter of --noNAME=VALUE
                reason = str(error).split(": ", 1)[-1]
                faults.append(Fault(f"--{name}", f"is wrong: {reason}"))
    values.mark_as_parsed()
    faults += check(values)
    named = ",".join(values[_TRUST].value or ()) if _TRUST in values else ""
    for reference in filter(None, named.split(",")):
        if not outside.is_found(reference):
            what = "is not the package.module:name of a module that Python finds"
            faults.append(Fault("--trust", what, value=reference))
        outside.trust(reference)
    if _CONFIG in values:
        config = _load(config_words, values[_CONFIG].default, faults)
        values[_CONFIG].value = config
        if config is not None:
            outside.trust(str(config.task))
        if faults and config is not None:
            faults += _value_problems(config)  # in the same message
    if faults:
        raise UsageError(dict.fromkeys(faults))
    return values


def read_config(words: Iterable[str]) -> Config:
    """Returns the config of words such as "--config=FILE", checked as by `parse`."""
    faults: list[Fault | str] = []
    config = _load(list(words), None, faults)
    if faults:
        raise UsageError(faults)
    return config


def run(main: Callable[[list[str]], int | None]) -> None:
    """Runs a command with `sys.argv` and ends with its exit status, None being 0."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # paths need not be UTF-8
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        status = main(sys.argv) or 0
    except UsageError as error:
        print(error, file=sys.stderr)
        status = 2
    except RunFailed as error:
        print(error, file=sys.stderr)
        status = 1
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        status = 130
    except BrokenPipeError:  # `... | head` has read enough
        sys.stdout = None
        status = 0
    sys.exit(status)


def define_config(values: flags.FlagValues, default: str | None = None) -> None:
    """Adds `--config=FILE.py[:ARG]` and `--config.FIELD=VALUE`."""
    flags.DEFINE_string(
        _CONFIG,
        default,
        "METHOD:TASK for the paper's settings, tiny:METHOD,TASK for small ones, "
        "expert:TASK, package.module:METHOD:TASK for a method of your own, or "
        "FILE.py[:ARGUMENT] with a get_config(); change a field with "
        "--config.FIELD=VALUE",
        flag_values=values,
    )


def define_trust(values: flags.FlagValues) -> None:
    """Adds `--trust=package.module:name`, code from outside that runs may name."""
    flags.DEFINE_multi_string(
        _TRUST,
        [],
        "package.module:name of methods or tasks from outside that runs may import, "
        "comma-separated",
        flag_values=values,
    )


def _name(word: str) -> str:
    return word.lstrip("-").partition("=")[0]


def joined(words: Sequence[str], values: flags.FlagValues | None = None) -> list[str]:
    """Joins "--name value" to "--name=value", and expands "~" in values."""
    values = values or flags.FlagValues()
    whole: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        name = _name(word)
        is_switch = name in values and values[name].boolean
        takes_value = name in values or name.startswith(f"{_CONFIG}.")
        if word.startswith("-") and "=" not in word and takes_value and not is_switch:
            has_value = rest and not rest[0].startswith("--")
            word = f"{word}={rest.pop(0)}" if has_value else word
        name, equals, value = word.partition("=")
        # The shell does not expand a "~" that follows a "=".
        parts = [os.path.expanduser(part) for part in value.split(",")]
        whole.append(f"{name}{equals}{','.join(parts)}")
    return whole


def _help(values: flags.FlagValues) -> str:
    """Lists flags by name, then the config's fields."""
    lines = []
    for name in sorted(values):
        flag = values[name]
        default = "" if flag.default is None else f" (default: {flag.default})"
        lines.append(f"  --{name}: {flag.help}{default}")
    if _CONFIG not in values:
        return "\n".join(lines)
    lines.append("\nFields, each --config.FIELD=VALUE:")
    lines += [_field_help(n, field) for n, field in jaxil_config.FIELDS.items()]
    for name, method in methods.known().items():
        for section, members in method.sections.items():
            lines.append(f"\n  of {name} ({method.label}):")
            lines += [_field_help(f"{section}.{n}", f) for n, f in members.items()]
    return "\n".join(lines)


def _field_help(name: str, field: methods.Field) -> str:
    limits = ""
    if field.choices:
        limits = f"; one of {', '.join(field.choices)}"
    elif field.low is not None and field.high is not None:
        above = "above " if field.positive else ""
        limits = f"; {above}{field.low:g} to {field.high:g}"
    elif field.low is not None:
        limits = f"; {'above' if field.positive else 'at least'} {field.low:g}"
    elif field.high is not None:
        limits = f"; at most {field.high:g}"
    return f"  {name}: {field.about} (default: {field.default!r}{limits})"


def _load(
    words: list[str], default: str | None, faults: list[Fault | str]
) -> Config | None:
    """Returns the config with its overrides, adding to `faults`; None without one."""
    files = [word for word in words if _name(word) == _CONFIG]
    value = files[-1].partition("=")[2] if files else default
    if not value:
        rule, way_out = "is missing", "name one, such as --config=pdac:walker_walk"
        faults.append(Fault("--config", rule, way_out))
        return None
    overrides = {
        _name(word).removeprefix(f"{_CONFIG}."): word.partition("=")[2]
        for word in words
        if word not in files
    }
    with collecting(faults):
        config = _config_of_file(value)
        if "method" in overrides:
            _change_method(config, overrides["method"])
        for field, text in overrides.items():
            faults.extend(_override(config, field, text))
        return config.lock()
    return None


def _config_of_file(value: str) -> Config:
    """Runs get_config of FILE.py[:ARGUMENT], or of a preset, NAME[:ARGUMENT]."""
    name, colon, argument = value.partition(":")
    path = pathlib.Path(name)
    is_file = os.path.isfile(path)
    if path.suffix != ".py" and not is_file:
        return presets.get_config(name, argument if colon else None).unlock()
    if not is_file:
        rule = f"names no file: there is no file {name!r} here"
        way_out = "a preset needs none: METHOD:TASK, such as --config=pdac:walker_walk"
        raise UsageError(Fault("--config", rule, way_out, value))
    own_name = f"preset_{path.stem}"  # the file may be called json.py
    spec = importlib.util.spec_from_loader(
        own_name, importlib.machinery.SourceFileLoader(own_name, str(path))
    )
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[own_name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        config = module.get_config(*([argument] if colon else []))
    except UsageError:
        raise
    except (Exception, SystemExit) as error:  # whatever the user's file raises
        rule = f"cannot be loaded: {raised(error)}"
        raise UsageError(Fault("--config", rule, value=value)) from error
    if not isinstance(config, ml_collections.ConfigDict):
        rule = "has a get_config() that does not return a ConfigDict"
        raise UsageError(Fault("--config", rule, value=value))
    there = flat(config.to_dict())
    method = there.get("method", "pdac")
    is_text = isinstance(method, str)
    fields = jaxil_config.fields(method) if is_text else jaxil_config.FIELDS
    checked = (
        declarations.type_problem(name, field, there[name])
        for name, field in fields.items()
        if name in there
    )
    if wrong := [fault for fault in checked if fault is not None]:
        raise UsageError(wrong)
    known = tuple(fields)
    lacking = [name for name in known if name not in there]
    if lacking:
        rule = f"has a get_config() that leaves out {', '.join(lacking[:3])}"
        way_out = "start from jaxil.config.default_config(METHOD, TASK)"
        raise UsageError(Fault("--config", rule, way_out, value))
    unknown = [name for name in there if name not in known]
    if unknown:
        raise UsageError([unknown_name("field", name, known) for name in unknown])
    return config.unlock()


def _change_method(config: Config, method: str) -> None:
    """Gives a config another method, and the sections that it needs."""
    wanted = jaxil_config.default_config(method, config.task)
    before = methods.get(config.method)
    for section in before.sections:
        if section not in wanted:
            del config[section]
    for section, fields in methods.get(method).sections.items():
        # Sections of one name are kept as far as the preset changed them.
        old, declared = config.get(section, {}), before.sections.get(section, {})
        changed = {
            name: value
            for name, value in old.items()
            if name in declared and value != declared[name].default
        }
        config[section] = {
            name: changed.get(name, field.default) for name, field in fields.items()
        }
    config.method = method
    if not methods.get(method).plays:
        config.total_frames = jaxil_config.frames_of_updates(config)
    elif not before.plays:
        config.total_frames = wanted.total_frames


def _override(config: Config, field: str, text: str) -> Iterable[Fault]:
    """Sets a field from text, in the type that it has."""
    known = tuple(jaxil_config.fields(config.method))
    if field not in known:
        return [unknown_name("field", field, known)]
    group, _, leaf = field.rpartition(".")
    target = config[group] if group else config
    try:
        target[leaf] = _parsed(text, target[leaf])
    except (ValueError, SyntaxError, TypeError):  # the last of "{{}}"
        expected = declarations.KINDS[type(target[leaf])]
        return [Fault(field, f"has the wrong type: expected {expected}", value=text)]
    return []


def _parsed(text: str, like: Any) -> Any:
    if isinstance(like, str):
        return text
    if isinstance(like, bool):
        names = {"true": True, "1": True, "false": False, "0": False}
        if text.lower() not in names:
            raise ValueError
        return names[text.lower()]
    if isinstance(like, tuple):
        value = ast.literal_eval(text)
        if not isinstance(value, tuple | list):
            raise ValueError
        return tuple(value)
    return type(like)(text)


def _value_problems(config: Config) -> list[Fault]:
    from jaxil.machine import startup

    startup.prepare()
    from jaxil.training import assembly

    return assembly.problems(config)
