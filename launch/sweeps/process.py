"""A process of this machine, known again."""

import dataclasses
import os
import pathlib


@dataclasses.dataclass(frozen=True)
class Process:
    """A process of this machine, told from later ones with the same number.

    Attributes:
      pid: its number.
      started: when, in the kernel's clock ticks.
    """

    pid: int
    started: str

    @classmethod
    def current(cls) -> "Process":
        """Returns the calling process."""
        return cls(os.getpid(), _start_of(os.getpid()))

    def is_alive(self) -> bool:
        """Returns whether it has not ended yet."""
        return _start_of(self.pid) == self.started


def _start_of(pid: int) -> str:
    """Returns when a process started; "" if it has ended."""
    try:
        text = pathlib.Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return ""
    # The name, in brackets, may hold blanks: count the fields after it.
    fields = text.rpartition(")")[2].split()
    return "" if fields[0] in "ZX" else fields[19]
