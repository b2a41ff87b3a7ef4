"""What is wrong with a sweep: each fault once, however many runs have it."""


class Faulty(Exception):
    """The request can't be met.

    Attributes:
      sentences: one for each reason.
    """

    def __init__(self, sentences: list[str]) -> None:
        super().__init__(*sentences)
        self.sentences = sentences


class Faults:
    """Collects what is wrong: each fault once, with the runs that have it."""

    def __init__(self) -> None:
        self._where: dict[str, list[str]] = {}

    def add(self, fault: str, where: str = "") -> None:
        """Notes a fault; `where` names the run that has it, "" for all."""
        self._where.setdefault(fault, []).append(where)

    def sentences(self, everywhere: set[str]) -> list[str]:
        """Returns the faults; one that is not found everywhere says where it is."""
        return [
            fault if {*where} >= everywhere or "" in where else _told(fault, where)
            for fault, where in self._where.items()
        ]

    def __bool__(self) -> bool:
        return bool(self._where)


def _told(fault: str, where: list[str]) -> str:
    shown = ", ".join(where[:3]) + (", ..." if len(where) > 3 else "")
    return f"{fault} [{shown}]"
