"""Figures of several panels: as files, and panel by panel for the page."""

import io
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxil.reporting.groups import Look
from jaxil.reporting.plots import INK

# In inches. Positions are computed, since Matplotlib's layout engines take twice as
# long as everything else.
_WIDTH, _HEIGHT = 4.3, 2.85  # of a panel in three columns
_FEWER_WIDTH = 10.0  # of all panels in a row of fewer
_FEWER_HEIGHT = 3.6
_MARGINS = (0.64, 0.14)  # left and right of the axes
_TOP, _BOTTOM = 0.12, 0.46  # above and below them
_TITLE = 0.24
_LEGEND_LINE = 0.19
_COLUMNS = 3
_LEGEND_WIDTH = 42  # characters; a longer label puts all labels into one column
_SETTINGS: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],  # comes with Matplotlib
    "font.size": 8.5,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "text.color": INK,
    "text.parse_math": False,  # so that "$" in a name is plain text
    "xtick.color": INK,
    "ytick.color": INK,
    "hatch.linewidth": 0.8,
    "svg.hashsalt": "jaxil",  # the same picture, the same bytes
}


class Panel(NamedTuple):
    """One plot."""

    title: str  # such as the task
    draw: Callable[[Axes], None]
    height: float | None = None  # in inches; None for that of curves
    margins: tuple[float, float] = _MARGINS  # left and right of the axes, in inches


class Sheet(NamedTuple):
    """A figure."""

    name: str  # of its files
    panels: tuple[Panel, ...]  # at least one
    legend: tuple[tuple[str, Look], ...] = ()  # empty where panels name their groups
    caption: str = ""


def inline_svg(panel: Panel, prefix: str, columns: int) -> str:
    """Returns a panel as an <svg> element in the page's colour and font.

    `prefix`, unique on the page, begins all its ids; `columns` is the number of panels
    beside each other on a wide page.
    """
    with matplotlib.rc_context({**_SETTINGS, "svg.fonttype": "none"}):
        figure, axes = _figure([panel], title=0.0, beside=columns)
        panel.draw(axes[0])
        text = _saved(figure, "svg", transparent=True).decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    head, _, rest = text.partition(">")
    # The page sets the size; the viewBox keeps the proportions.
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    text = f'{head} role="img">{rest}'
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = re.sub(r'(href="|url\()#', rf"\1#{prefix}-", text)
    return text.replace(INK, "currentColor").strip()


def write(sheet: Sheet, folder: pathlib.Path) -> None:
    """Writes NAME.png and NAME.svg."""
    with matplotlib.rc_context({**_SETTINGS, "svg.fonttype": "path"}):
        figure, axes = _figure(
            sheet.panels, sheet.legend, title=_TITLE, beside=len(sheet.panels)
        )
        for panel, ax in zip(sheet.panels, axes, strict=True):
            panel.draw(ax)
            ax.set_title(panel.title)
        for kind in ("png", "svg"):
            (folder / f"{sheet.name}.{kind}").write_bytes(_saved(figure, kind))


def _figure(
    panels: Sequence[Panel],
    legend: Sequence[tuple[str, Look]] = (),
    *,
    title: float,
    beside: int,
) -> tuple[Figure, list[Axes]]:
    """Returns a figure with its legend, and the axes of each panel.

    `title` is the height of a panel's title; `beside` how many panels share a row.
    """
    columns = min(_COLUMNS, len(panels))
    is_wide = beside < _COLUMNS
    each_width = _FEWER_WIDTH / beside if is_wide else _WIDTH
    usual = _FEWER_HEIGHT if is_wide else _HEIGHT
    heights = [panel.height or usual for panel in panels]
    is_long = any(len(label) > _LEGEND_WIDTH for label, _ in legend)
    legend_columns = 1 if is_long else columns
    legend_height = _LEGEND_LINE * -(-len(legend) // legend_columns)
    firsts = range(0, len(panels), columns)
    rows = [title + max(heights[k : k + columns]) for k in firsts]
    width, height = each_width * columns, sum(rows) + legend_height
    # Not pyplot: a separate Figure needs no display and leaves no global state.
    figure = Figure(figsize=(width, height), dpi=150)
    FigureCanvasAgg(figure)
    axes = []
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        left, right = panel.margins
        across, high = each_width - left - right, heights[index] - _TOP - _BOTTOM
        x = column * each_width + left
        y = height - sum(rows[:row]) - title - _TOP - high
        box = (x / width, y / height, across / width, high / height)
        axes.append(figure.add_axes(box))
    if legend:
        handles = [
            Line2D([], [], color=look.colour, ls=look.line, lw=1.8, label=label)
            for label, look in legend
        ]
        figure.legend(
            handles=handles,
            loc="lower left",
            ncols=legend_columns,
            frameon=False,
            fontsize=8,
            handlelength=3,
        )
    return figure, axes


def _saved(figure: Figure, kind: str, *, transparent: bool = False) -> bytes:
    stream = io.BytesIO()
    # Without date and version, the same runs give the same bytes.
    metadata = {"svg": {"Date": None, "Creator": None}, "png": {"Software": None}}
    figure.savefig(
        stream, format=kind, metadata=metadata[kind], transparent=transparent
    )
    return stream.getvalue()
