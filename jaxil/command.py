"""What all commands share: flags in, one message and an exit status out.

Exit status: 0 done; 2 wrong use, with one message that names every fault; 1 else.
"""

import contextlib
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from absl import flags
from ml_collections import config_flags

from jaxil import config as jaxil_config

Define = Callable[[flags.FlagValues], None]


class UsageError(Exception):
    """The user asked for what can't be done; the message says why and what to do."""


def parse(argv: list[str], description: str, define: Define) -> flags.FlagValues:
    """Reads the command line, collecting every fault before it gives up.

    Args:
      argv: as in `sys.argv`.
      description: what `--help` says first.
      define: adds the command's flags.

    Raises:
      UsageError: names all flags and config fields that are wrong.
      SystemExit: status 0, after `--help`.
    """
    if any(word in ("--help", "-h", "-help", "--helpfull") for word in argv[1:]):
        values = flags.FlagValues()
        define(values)
        print(f"{description.strip()}\n\n{values.main_module_help()}{_help(values)}")
        raise SystemExit(0)
    problems: list[str] = []
    arguments = [word for word in argv if not _names_missing_file(word, problems)]
    while True:
        values = flags.FlagValues()
        define(values)
        try:
            with _sys_argv(arguments):
                rest = values(arguments)
        except (flags.Error, AttributeError, KeyError, TypeError, ValueError) as error:
            culprit = _culprit(arguments, error)
            problems.append(_sentence(culprit, error, values))
            if culprit is None:
                break
            # Without the faulty word, the next fault comes to light.
            arguments.remove(culprit)
            continue
        except (OSError, SyntaxError, ImportError) as error:
            problems.append(f"--config: the file can't be read: {error}")
            break
        problems += [
            f"{word!r} is not a flag; flags start with --" for word in rest[1:]
        ]
        break
    if "config" in values and not problems:
        problems += _config_file_problems(values)
    if problems:
        # Faults of the config's values belong in the same message.
        problems += _value_problems(values)
        raise UsageError(listing(problems))
    return values


def _names_missing_file(word: str, problems: list[str]) -> bool:
    """Says whether a word is `--config=FILE[:ARG]` without such a file."""
    name, _, value = word.lstrip("-").partition("=")
    path = pathlib.Path(value.split(":")[0])
    if not word.startswith("-") or name != "config" or path.is_file():
        return False
    problems.append(
        f"--config={value!r}: there is no file {str(path)!r} here; the presets are in "
        "configs/, such as configs/pdac.py:walker_walk"
    )
    return True


def listing(faults: list[str]) -> str:
    """Returns the message for a user, all faults together."""
    return "This can't start:\n" + "\n".join(f"  - {fault}" for fault in faults)


def run(main: Callable[[list[str]], int | None]) -> None:
    """Runs a command and turns its outcome into an exit status.

    Args:
      main: takes `sys.argv`; returns the status, None for 0.
    """
    try:
        status = main(sys.argv) or 0
    except UsageError as error:
        print(error, file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        status = 130
    except BrokenPipeError:  # `... | head` has read enough
        sys.stdout = None
        status = 0
    sys.exit(status)


def define_config(values: flags.FlagValues, default: str | None = None) -> None:
    """Adds `--config=FILE.py[:ARG]` and `--config.FIELD=VALUE`."""
    config_flags.DEFINE_config_file(
        "config",
        default,
        "configs/METHOD.py:TASK, or any file with get_config(); change a field with "
        "--config.FIELD=VALUE",
        flag_values=values,
        lock_config=True,
    )


def _help(values: flags.FlagValues) -> str:
    """Lists flags by name; absl groups them by module, and ours belong to none."""
    lines = []
    for name in sorted(values):
        flag = values[name]
        default = "" if flag.default is None else f" (default: {flag.default})"
        lines.append(f"  --{name}: {flag.help}{default}")
    return "\n".join(lines)


@contextlib.contextmanager
def _sys_argv(arguments: list[str]) -> Iterator[None]:
    # ml_collections looks for overrides in sys.argv, whatever it is asked to parse.
    before, sys.argv = sys.argv, arguments
    try:
        yield
    finally:
        sys.argv = before


def _culprit(arguments: list[str], error: Exception) -> str | None:
    """Returns the argument that an error is about."""
    text = str(error)
    for word in arguments[1:]:
        name = word.lstrip("-").split("=")[0]
        if isinstance(error, AttributeError | KeyError):
            parts = name.split(".")
            if parts[0] == "config" and _missing_field(error) in parts[1:]:
                return word
        elif name and (f"--{name}=" in text or f"'{name}'" in text):
            return word
    return None


def _missing_field(error: Exception) -> str:
    """Returns the field that ml_collections did not find, from its error."""
    inner: Any = error
    while isinstance(inner, Exception):  # one error may hold another
        inner = inner.args[0] if inner.args else ""
    # A second line may guess what was meant; the message has its own guess.
    return str(inner).split("\n")[0].strip("'\"")


def _sentence(culprit: str | None, error: Exception, values: flags.FlagValues) -> str:
    if culprit is None:
        return str(error)
    name, _, value = culprit.lstrip("-").partition("=")
    if isinstance(error, AttributeError | KeyError):
        fields = tuple(_field_names(values))
        return jaxil_config.unknown_name("field", name.removeprefix("config."), fields)
    if isinstance(error, flags.UnrecognizedFlagError):
        known = tuple(f"--{flag}" for flag in values)
        return jaxil_config.unknown_name("flag", f"--{name}", known)
    if name == "config":
        reason = str(error).strip().splitlines()[-1]
        return f"--config={value}: {reason}"
    reason = str(error).split(": ", 1)[-1]
    return f"{name.removeprefix('config.')}={value!r} has the wrong type: {reason}"


def _field_names(values: flags.FlagValues) -> Iterator[str]:
    config = _config_of(values) or jaxil_config.default_config()
    for name, value in config.items():
        if hasattr(value, "items"):
            yield from (f"{name}.{inner}" for inner in value)
        else:
            yield name


def _config_of(values: flags.FlagValues) -> Any:
    """Returns the parsed config; None where there is none or it can't be loaded."""
    if "config" not in values:
        return None
    config = values["config"].value
    try:
        # ml_collections keeps a file's error until something of it is read.
        return config if hasattr(config, "items") else None
    except Exception:
        return None


def _config_file_problems(values: flags.FlagValues) -> list[str]:
    config = values["config"].value
    if config is None:
        return ["--config is missing: give a file, such as configs/pdac_walker.py"]
    try:
        has_fields = hasattr(config, "items")
    except Exception as error:  # whatever the user's file raised
        return [f"--config: {str(error).strip().splitlines()[0]}"]
    if has_fields:
        return []
    return ["--config: the file's get_config() must return a ConfigDict"]


def _value_problems(values: flags.FlagValues) -> list[str]:
    config = _config_of(values)
    if config is None:
        return []
    from jaxil.machine import startup

    startup.prepare()
    from jaxil.training import assembly

    return assembly.problems(config)
