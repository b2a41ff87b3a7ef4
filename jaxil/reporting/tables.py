"""A table as CSV, exact, and as HTML, for people."""

import csv
import html
import io
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

Kind = Literal["text", "count", "return", "share", "hours"]
_MISSING = "–"
_MEDIUM, _LONG = 16, 60  # characters; a cell with more needs room


class Column(NamedTuple):
    """One column.

    Attributes:
      key: its name in the CSV file.
      title: its name on the page.
      kind: what it holds; all but text is right-aligned.
    """

    key: str
    title: str
    kind: Kind = "text"


class Table(NamedTuple):
    """Rows of cells; None and NaN are missing.

    Attributes:
      name: of its file.
      columns: what the cells are.
      rows: as long as `columns`.
    """

    name: str
    columns: tuple[Column, ...]
    rows: Sequence[Sequence[Any]]


def to_csv(table: Table) -> bytes:
    """Returns the table with every digit; missing cells are empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([column.key for column in table.columns])
    for row in table.rows:
        writer.writerow([_exact(cell) for cell in row])
    return stream.getvalue().encode()


def to_html(table: Table) -> str:
    """Returns the table in a box that scrolls when it is wider than the page."""
    head = "".join(
        f'<th scope="col"{_align(column)}>{html.escape(column.title)}</th>'
        for column in table.columns
    )
    body = "\n".join(f"<tr>{_row(table.columns, row)}</tr>" for row in table.rows)
    return (
        f'<div class="scroll" tabindex="0"><table data-name="{table.name}">'
        f"<thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>"
    )


def _row(columns: Sequence[Column], row: Sequence[Any]) -> str:
    cells = []
    for column, cell in zip(columns, row, strict=True):
        key = "" if _is_missing(cell) else html.escape(str(_exact(cell)), quote=True)
        text = html.escape(_shown(cell, column.kind))
        kind = _align(column) or _room(text)
        cells.append(f'<td{kind} data-sort="{key}">{text}</td>')
    return "".join(cells)


def _room(text: str) -> str:
    if len(text) > _LONG:
        return ' class="long"'
    return ' class="medium"' if len(text) > _MEDIUM else ""


def _align(column: Column) -> str:
    return "" if column.kind == "text" else ' class="number"'


def _is_missing(cell: Any) -> bool:
    is_number = isinstance(cell, float | np.floating | np.ndarray)
    return cell is None or (is_number and bool(np.isnan(cell)))


def _exact(cell: Any) -> Any:
    if _is_missing(cell):
        return ""
    if isinstance(cell, float | np.floating | np.ndarray):
        number = float(cell)
        whole = number.is_integer() and abs(number) < 1e15
        return int(number) if whole else repr(number)
    return cell


def _shown(cell: Any, kind: Kind) -> str:
    if _is_missing(cell):
        return _MISSING
    if kind == "count":
        return f"{cell:,.0f}"
    if kind == "return":
        return f"{cell:.1f}"
    if kind == "share":
        return f"{100 * cell:.0f} %"
    if kind == "hours":
        return f"{cell:.2f}"
    return str(cell)
