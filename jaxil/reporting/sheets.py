"""Figures of several panels: as files, and panel by panel for the page."""

import io
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from jaxil.reporting.appearance import INK, Look

_WIDTH, _HEIGHT = 4.3, 2.85  # inches of a panel
_COLUMNS = 3
_LEGEND_WIDTH = 32  # characters; with a longer label, one below the other
_SETTINGS = {
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
    "text.parse_math": False,  # a "$" in a name is no formula
    "xtick.color": INK,
    "ytick.color": INK,
    "hatch.linewidth": 0.8,
    "svg.hashsalt": "jaxil",  # the same picture, the same bytes
}


class Panel(NamedTuple):
    """One plot.

    Attributes:
      title: such as the task.
      draw: draws it onto Matplotlib's axes.
      height: in inches.
    """

    title: str
    draw: Callable[[Any], None]
    height: float = _HEIGHT


class Sheet(NamedTuple):
    """A figure.

    Attributes:
      name: of its files.
      panels: at least one.
      legend: labels with their looks; empty where panels say it themselves.
      caption: what one sees, in a sentence or two.
    """

    name: str
    panels: tuple[Panel, ...]
    legend: tuple[tuple[str, Look], ...] = ()
    caption: str = ""


def inline_svg(panel: Panel, prefix: str) -> str:
    """Returns a panel as an <svg> element in the page's colour and font.

    Args:
      panel: what to draw.
      prefix: of all ids in it, unique on the page.
    """
    with _context({"svg.fonttype": "none"}):
        figure, axes = _figure(1, 1, panel.height)
        panel.draw(axes[0])
        text = _saved(figure, "svg", transparent=True).decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    head, _, rest = text.partition(">")
    # Its size is the page's affair; the viewBox keeps the proportions.
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    text = f'{head} role="img">{rest}'
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = re.sub(r'(href="|url\()#', rf"\1#{prefix}-", text)
    return text.replace(INK, "currentColor").strip()


def write(sheet: Sheet, folder: pathlib.Path) -> None:
    """Writes NAME.png and NAME.svg."""
    columns = min(_COLUMNS, len(sheet.panels))
    rows = -(-len(sheet.panels) // columns)
    height = max(panel.height for panel in sheet.panels) + 0.25
    with _context({"svg.fonttype": "path"}):
        figure, axes = _figure(rows, columns, height, sheet.legend)
        for place, ax in enumerate(axes):
            if place < len(sheet.panels):
                sheet.panels[place].draw(ax)
                ax.set_title(sheet.panels[place].title)
            else:
                ax.set_axis_off()
        # Laid out once for both.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for kind in ("png", "svg"):
            (folder / f"{sheet.name}.{kind}").write_bytes(_saved(figure, kind))


def swatch(look: Look) -> str:
    """Returns a short line in a variant's look, as an <svg> element."""
    dashes = " ".join(f"{2 * length:g}" for length in look.dashes) or "none"
    return (
        '<svg class="swatch" viewBox="0 0 34 10" aria-hidden="true">'
        f'<line x1="1" y1="5" x2="33" y2="5" stroke="{look.colour}" stroke-width="3" '
        f'stroke-dasharray="{dashes}"/></svg>'
    )


def _context(more: dict[str, Any]) -> Any:
    import matplotlib

    return matplotlib.rc_context({**_SETTINGS, **more})


def _figure(
    rows: int,
    columns: int,
    height: float,
    legend: Sequence[tuple[str, Look]] = (),
) -> tuple[Any, list[Any]]:
    # Not pyplot: a Figure of one's own needs no display and leaves no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    long = any(len(label) > _LEGEND_WIDTH for label, _ in legend)
    legend_columns = 1 if long else columns
    legend_rows = -(-len(legend) // legend_columns)
    size = (_WIDTH * columns, height * rows + 0.2 * legend_rows)
    figure = Figure(
        figsize=size,
        dpi=150,
        layout="constrained" if legend or rows * columns > 1 else "tight",
    )
    FigureCanvasAgg(figure)
    if legend:
        handles = [
            Line2D([], [], color=look.colour, ls=look.line, lw=1.8, label=label)
            for label, look in legend
        ]
        figure.legend(
            handles=handles,
            loc="outside lower left",
            ncols=legend_columns,
            frameon=False,
            fontsize=8,
            handlelength=3,
        )
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def _saved(figure: Any, kind: str, *, transparent: bool = False) -> bytes:
    stream = io.BytesIO()
    # No date and no version: the same runs give the same bytes.
    metadata = {"svg": {"Date": None, "Creator": None}, "png": {"Software": None}}
    figure.savefig(
        stream, format=kind, metadata=metadata[kind], transparent=transparent
    )
    return stream.getvalue()
