"""The page: one HTML file that needs no network, laid out by page.html.jinja."""

import base64
import itertools
import pathlib
from typing import Any

import jinja2
from markupsafe import Markup

from jaxil.reporting import tables
from jaxil.reporting.folder import MARK
from jaxil.reporting.sheets import Panel, inline_svg


def html(content: dict[str, Any]) -> bytes:
    """Returns the whole file; all text is escaped.

    Args:
      content: what the template names: heading, reload_seconds (or None), facts
        (numbers with what they count), shared (settings unlike the paper's), legend,
        settings (a table), by_frames, by_hours, bars, distance, logits and metrics
        (sheets or None), paper (`PaperFigure`s), episodes, tables and remarks.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(pathlib.Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    prefixes = (f"s{number}" for number in itertools.count())
    captions: set[str] = set()

    def svg(panel: Panel, columns: int) -> Markup:
        return Markup(inline_svg(panel, next(prefixes), columns))

    def once(caption: str) -> str:
        is_new = caption not in captions
        captions.add(caption)
        return caption if is_new else ""

    page = environment.get_template("page.html.jinja").render(
        **content,
        mark=Markup(MARK),
        svg=svg,
        once=once,
        base64=lambda video: base64.b64encode(video).decode(),
        title=tables.title,
        is_number=tables.is_number,
        shown=tables.shown,
        exact=tables.exact,
    )
    return page.encode(errors="replace")
