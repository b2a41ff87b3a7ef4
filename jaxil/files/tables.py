"""Tables of numbers (CSV) that survive kills."""

import csv
import io
import math
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from jaxil.files import writing


class CsvLog:
    """A table with a column "frame", to which rows are appended."""

    def __init__(
        self,
        path: str | os.PathLike,
        columns: Iterable[str],
        *,
        resume_frame: int | None = None,
        say: Callable[[str], None] = print,
    ):
        """Writes the header, or on resume drops the rows that will be written again.

        Args:
          path: the file. It is replaced unless `resume_frame` is given.
          columns: names in their order.
          resume_frame: rows of later frames are dropped, as is a last line that was
            cut off. Columns that the file has and `columns` lacks are dropped too; new
            ones are empty in old rows.
          say: told if the old file is damaged, which is then kept under another name.

        Raises:
          ValueError: if "frame" is not among the columns.
          OSError: if the file cannot be written.
        """
        self._path = pathlib.Path(path)
        self._columns = tuple(columns)
        if "frame" not in self._columns:
            raise ValueError(f'columns = {self._columns}: expected "frame" among them')
        rows: list[dict[str, str]] = []
        if resume_frame is not None and self._path.exists():
            try:
                rows = _read(self._path)[1]
                rows = [row for row in rows if float(row["frame"]) <= resume_frame]
            except (ValueError, IsADirectoryError) as error:
                aside = _set_aside(self._path)
                rows = []
                say(f"{error}; kept as {aside.name}, {self._path.name} starts empty")
        header = dict(zip(self._columns, self._columns))
        writing.write_atomically(self._path, self._format([header, *rows]))

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds one row, at once.

        Args:
          row: scalars by column; a column that is missing stays empty.

        Raises:
          ValueError: if the table has no such column.
          OSError: if the row cannot be written.
        """
        unknown = sorted(set(row) - set(self._columns))
        if unknown:
            raise ValueError(
                f"{self._path.name} has no column {', '.join(unknown)}: expected"
                f" {', '.join(self._columns)}"
            )
        # Opened each time, so that a table that has been deleted or moved is noticed.
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
    """Reads a table of numbers; a last line that was cut off is left out.

    Returns:
      A float64 array for each column; empty cells are NaN.

    Raises:
      OSError: if the file cannot be read.
      ValueError: if it has no header with "frame", or a cell that is not a number.
    """
    columns, rows = _read(pathlib.Path(path))
    try:
        return {
            column: np.array([float(row[column] or math.nan) for row in rows])
            for column in columns
        }
    except ValueError as error:
        raise ValueError(f"{path}: expected numbers only, {error}") from error


def _read(path: pathlib.Path) -> tuple[list[str], list[dict[str, str]]]:
    """Returns the columns, and the rows by column."""
    content = path.read_bytes()
    try:
        # A row counts once its line has an end: a kill in mid-write leaves none.
        text = content[: content.rfind(b"\n") + 1].decode()
        columns, *rows = [*csv.reader(io.StringIO(text))] or [[]]
        table = [dict(zip(columns, row, strict=True)) for row in rows if row]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path}: expected a table, {error}") from error
    if "frame" not in columns:
        raise ValueError(f'{path}: expected a header line with "frame" in it')
    return columns, table


def _set_aside(path: pathlib.Path) -> pathlib.Path:
    """Renames a file to a free name, PATH.damaged or PATH.damaged2 and so on."""
    aside, again = path.with_name(f"{path.name}.damaged"), 1
    while aside.exists():
        again += 1
        aside = path.with_name(f"{path.name}.damaged{again}")
    return path.rename(aside)


def _cell(value: Any) -> str:
    """Writes a scalar with the fewest digits that give it back exactly in its dtype."""
    return value if isinstance(value, str) else str(np.asarray(value)[()])
