"""CSV tables of numbers that survive a kill in mid-write."""

import array
import csv
import io
import math
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from jaxil.files import untrusted, writing

# The longest runs' tables have some megabytes.
_MAX_BYTES = 2**26


class CsvLog:
    """An append-only table with a column "frame"."""

    def __init__(
        self,
        path: str | os.PathLike,
        columns: Iterable[str],
        *,
        resume_frame: int | None = None,
        kept_from: float = math.inf,
        say: Callable[[str], None] = print,
    ):
        """Starts a new file, or with `resume_frame` continues the old one.

        Args:
          path: the file.
          columns: in order, "frame" among them. On resume, columns not listed are
            dropped, and new ones are empty in old rows.
          resume_frame: rows after this frame are dropped, as is an incomplete last
            line.
          kept_from: an old file that goes on after this frame is renamed, not replaced
            by a new one.
          say: receives a message if an old file, damaged or not, is renamed.
        """
        self._path = pathlib.Path(path)
        self._columns = tuple(columns)
        rows: list[dict[str, str]] = []
        if self._path.exists():
            name = self._path.name
            try:
                names, lines = _read(self._path)
                rows = [dict(zip(names, line)) for line in lines]
                frames = [float(row["frame"]) for row in rows]
                if resume_frame is None:
                    rows = []
                    if any(frame >= kept_from for frame in frames[:-1]):
                        aside = _set_aside(self._path, "old")
                        say(f"no checkpoint: the former {name} is kept as {aside.name}")
                else:
                    rows = [
                        r for r, frame in zip(rows, frames) if frame <= resume_frame
                    ]
            except (ValueError, OSError) as error:
                aside = _set_aside(self._path, "damaged")
                rows = []
                say(f"{error}; kept as {aside.name}, {name} starts empty")
        header = dict(zip(self._columns, self._columns))
        writing.write_atomically(self._path, self._format([header, *rows]))

    def append(self, row: Mapping[str, Any]) -> None:
        """Writes one row of scalars; missing columns stay empty.

        Raises:
          ValueError: the table has no such column.
        """
        unknown = sorted(set(row) - set(self._columns))
        if unknown:
            raise ValueError(
                f"{self._path.name} has no column {', '.join(unknown)}: expected"
                f" {', '.join(self._columns)}"
            )
        # Reopened for each row, to notice that the table was deleted or moved.
        with self._path.open("r+b") as file:
            file.seek(0, os.SEEK_END)
            file.write(self._format([row]))

    def _format(self, rows: Iterable[Mapping[str, Any]]) -> bytes:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(
            [_cell(row.get(column, "")) for column in self._columns] for row in rows
        )
        return text.getvalue().encode()


def read_csv(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Reads each column as float64, with NaN for empty cells.

    An incomplete last line is left out.

    Raises:
      ValueError: there is no header with "frame", or a cell is not a number.
    """
    columns, rows = _read(pathlib.Path(path))
    # Eight bytes a number: a table from elsewhere may have many rows.
    values = [array.array("d") for _ in columns]
    for row in rows:
        for column, cell in zip(values, row):
            try:
                column.append(float(cell or math.nan))
            except ValueError as error:
                raise ValueError(f"{path}: expected numbers only, {error}") from error
    return {name: np.array(column) for name, column in zip(columns, values)}


def _read(path: pathlib.Path) -> tuple[list[str], Iterator[list[str]]]:
    """Returns the names of the columns, and the rows, each as long as these."""
    content = untrusted.read_regular(path, _MAX_BYTES)
    try:
        # A kill in mid-write leaves a last line without a line end.
        text = content[: content.rfind(b"\n") + 1].decode()
        rows = csv.reader(io.StringIO(text))
        columns = next(rows, [])
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path}: expected a table, {error}") from error
    if "frame" not in columns:
        raise ValueError(f'{path}: expected a header line with "frame" in it')

    def checked() -> Iterator[list[str]]:
        try:
            for row in filter(None, rows):
                if len(row) != len(columns):
                    raise csv.Error(
                        f"line {rows.line_num} has {len(row)} cells, not {len(columns)}"
                    )
                yield row
        except csv.Error as error:
            raise ValueError(f"{path}: expected a table, {error}") from error

    return columns, checked()


def _set_aside(path: pathlib.Path, word: str) -> pathlib.Path:
    """Renames a file to PATH.WORD, or to PATH.WORD2, ..."""
    aside, again = path.with_name(f"{path.name}.{word}"), 1
    while aside.exists():
        again += 1
        aside = path.with_name(f"{path.name}.{word}{again}")
    return path.rename(aside)


def _cell(value: Any) -> str:
    """Formats a scalar with the fewest digits that restore it exactly in its dtype."""
    return value if isinstance(value, str) else str(np.asarray(value)[()])
