"""The command `jaxil`, also `python -m jaxil`."""

import importlib

from jaxil.errors import UsageError, unknown_name

# Each is a module with `main(argv)`, also reached by `python -m jaxil.MODULE`.
_COMMANDS = {
    "train": ("launch", "train an agent, or resume"),
    "evaluate": ("evaluate", "evaluate a run's newest checkpoint: returns and a video"),
    "collect": ("collect", "record, inspect or convert demonstrations"),
    "report": ("report", "make one page of any runs"),
    "sweep": ("sweep", "train many runs, here or on Slurm"),
    "export": ("export", "write a run's policy to a file that needs no jaxil"),
    "benchmark": ("benchmark", "time the parts of a run"),
    "doctor": ("doctor", "check this machine"),
}


def main(argv: list[str]) -> int | None:
    """Runs the command that the first word names; returns its exit status."""
    word, *rest = argv[1:] or ["--help"]
    if word in ("--help", "-h", "help"):
        lines = [f"  {name:<10} {about}" for name, (_, about) in _COMMANDS.items()]
        print("Imitation learning from pixel observations.\n")
        print("  jaxil COMMAND --FLAG=VALUE ...\n", *lines, sep="\n")
        print("\n`jaxil COMMAND --help` lists the command's flags.")
        return 0
    if word not in _COMMANDS:
        raise UsageError(unknown_name("command", word, tuple(_COMMANDS)))
    module, _ = _COMMANDS[word]
    return importlib.import_module(f"jaxil.{module}").main([f"jaxil {word}", *rest])


def run() -> None:
    """Runs `main` as the console command."""
    from jaxil import command

    command.run(main)


if __name__ == "__main__":
    run()
