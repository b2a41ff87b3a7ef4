"""User errors as data: field, value, rule, way out."""

import contextlib
import dataclasses
import difflib
import pathlib
import sysconfig
import traceback
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

_SHORT_LIST = 20
_MAX_VALUE, _MAX_FAULT = 200, 4000  # characters shown
_ABSENT = object()
_PACKAGE = str(pathlib.Path(__file__).parent / "_")[:-1]  # with the separator
_STANDARD = sysconfig.get_path("stdlib")
_INSTALLED = ("site-packages", "dist-packages")  # folders of installed packages


def printable(text: object, max_length: int = 1000) -> str:
    """Returns text on one line, without control characters and of bounded length.

    Text from files goes through it before it is shown, because terminals obey control
    characters.
    """
    start = str(text)[: max_length + 1]
    shown = "".join(
        c if c.isprintable() else " " if c.isspace() else "?" for c in start
    )
    return shown if len(shown) <= max_length else f"{shown[: max_length - 3]}..."


@dataclasses.dataclass(frozen=True)
class Fault:
    """One reason why a request is invalid: a sentence that starts with `subject`."""

    subject: str  # the config field, flag or file
    rule: str  # what is wrong with it
    way_out: str = ""  # what to do instead; empty if the rule says it
    value: Any = _ABSENT  # what was given

    def __str__(self) -> str:
        end = f" {self.rule}; {self.way_out}" if self.way_out else f" {self.rule}"
        if self.value is _ABSENT:
            return f"{self.subject}{end}"
        return f"{self.subject}={printable(repr(self.value), _MAX_VALUE)}{end}"

    def __hash__(self) -> int:
        return hash(str(self))  # values need not be hashable

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Fault) and str(self) == str(other)


class UsageError(Exception):
    """The user asked for something impossible; `faults` says why."""

    def __init__(self, faults: "str | Fault | Iterable[str | Fault]") -> None:
        if isinstance(faults, str | Fault):
            faults = [faults]
        self.faults: tuple[str | Fault, ...] = tuple(faults)
        super().__init__(self.faults)

    def __str__(self) -> str:
        shown = [printable(fault, _MAX_FAULT) for fault in self.faults]
        if len(shown) == 1:
            return shown[0]
        return "Several faults:\n" + "\n".join(f"  - {f}" for f in shown)


@contextlib.contextmanager
def collecting(faults: list[str | Fault]) -> Iterator[None]:
    """Adds the faults of a UsageError in this block to a list, and goes on."""
    try:
        yield
    except UsageError as error:
        faults += error.faults


class RunFailed(RuntimeError):
    """The run cannot continue; the message says why."""


class EnvironmentsFailed(RunFailed):
    """A task or policy raised an error, or a process keeps dying."""


class MethodError(RunFailed):
    """A method breaks its interface, or one of the user's own raised an error."""


class TrainingDiverged(RunFailed):
    """A loss, a reward or an action is no longer a finite number."""


@contextlib.contextmanager
def told_as(
    who: str, what: str, kind: type[RunFailed] = EnvironmentsFailed
) -> Iterator[None]:
    """Raises a RunFailed of a kind for any error of the user's code in this block.

    It names `who`, such as "the task" or a method, and `what` was being done.
    """
    try:
        yield
    except (RunFailed, UsageError):
        raise
    except (Exception, SystemExit) as error:
        words = " ".join(raised(error).split())  # jax's take many lines
        raise kind(f"{who} raised an error in {what}: {words}") from error


def raised(error: BaseException) -> str:
    """Describes an error of code that jaxil called, with the user's nearest line.

    A ValueError that jaxil itself raised is given as it is: it says what is wrong.
    """
    frames = traceback.extract_tb(error.__traceback__)
    files = [frame.filename for frame in frames]
    if isinstance(error, ValueError) and files and files[-1].startswith(_PACKAGE):
        return str(error)
    text = ": ".join(filter(None, (type(error).__name__, str(error).strip())))
    if isinstance(error, SyntaxError) and not (error.filename or "<").startswith("<"):
        return text  # it ends with file and line
    outside = [frame for frame in frames if not _is_known(frame.filename)]
    own = [f for f in outside if not _is_installed(f.filename)] or outside
    if not own:
        return text
    return f"{text} ({pathlib.Path(own[-1].filename).name}, line {own[-1].lineno})"


def _is_installed(file: str) -> bool:
    return any(part in _INSTALLED for part in pathlib.Path(file).parts)


def _is_known(file: str) -> bool:
    """Returns whether a file is jaxil's, Python's own, or none."""
    is_pythons = file.startswith(_STANDARD) and not _is_installed(file)
    return file.startswith(("<", _PACKAGE)) or is_pythons


def unknown_name(subject: str, value: object, known: Sequence[str]) -> Fault:
    """Returns the fault of an unknown name, with the closest known ones."""
    close = []
    if len(known) > _SHORT_LIST:
        close = difflib.get_close_matches(str(value), known, n=3, cutoff=0.5)
    more = ["..."] if len(known) > _SHORT_LIST else []
    hint = "did you mean" if close else "choose one of"
    shown = ", ".join(close or [*known[:_SHORT_LIST], *more])
    return Fault(subject, "is unknown", f"{hint}: {shown}", value)
