"""The page: one file of HTML that needs nothing else and asks nobody."""

import base64
import html
import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from jaxil.reporting import figures, sheets
from jaxil.reporting.episodes import Episode, return_at
from jaxil.reporting.folder import MARK
from jaxil.reporting.paper import PaperFigure
from jaxil.reporting.sheets import Sheet
from jaxil.reporting.style import CSS, SCRIPT
from jaxil.reporting.tables import Table, to_html

# The browser itself forbids every request.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "img-src data:; media-src data:"
)


class Page:
    """Collects sections, in their order; every text is escaped here."""

    def __init__(self, title: str):
        """Begins a page without sections."""
        self._title = title
        self._sections: list[tuple[str, str]] = []
        self._parts: list[str] = []
        self._prefixes = (f"s{number}" for number in itertools.count())

    def section(self, title: str) -> None:
        """Begins a section; what follows belongs to it."""
        name = f"section{len(self._sections) + 1}"
        self._sections.append((name, title))
        self._parts.append(f'<h2 id="{name}">{_text(title)}</h2>')

    def heading(self, text: str) -> None:
        """Adds a heading within a section."""
        self._parts.append(f"<h3>{_text(text)}</h3>")

    def paragraph(self, text: str, *, soft: bool = False) -> None:
        """Adds a paragraph; an empty text adds none."""
        if text:
            kind = ' class="soft"' if soft else ""
            self._parts.append(f"<p{kind}>{_text(text)}</p>")

    def facts(self, numbers: Iterable[tuple[str, str]]) -> None:
        """Adds large numbers, each with what it counts."""
        items = "".join(
            f"<li><b>{_text(number)}</b><span>{_text(what)}</span></li>"
            for number, what in numbers
        )
        self._parts.append(f'<ul class="facts">{items}</ul>')

    def remarks(self, sentences: Sequence[str]) -> None:
        """Adds what a reader should know, if there is anything."""
        if sentences:
            items = "".join(f"<li>{_text(sentence)}</li>" for sentence in sentences)
            self._parts.append(f'<ul class="remarks">{items}</ul>')

    def table(self, table: Table) -> None:
        """Adds a table."""
        self._parts.append(to_html(table))

    def sheet(self, sheet: Sheet | None, missing: str) -> None:
        """Adds a figure, or a sentence where there is none."""
        if sheet is None:
            self.paragraph(missing, soft=True)
            return
        legend = "".join(
            f"<li>{sheets.swatch(look)}<span>{_text(label)}</span></li>"
            for label, look in sheet.legend
        )
        panels = "".join(
            f'<div class="panel"><h4>{_text(panel.title)}</h4>'
            f"{sheets.inline_svg(panel, next(self._prefixes))}</div>"
            for panel in sheet.panels
        )
        self._parts.append(
            f'<figure id="{sheet.name}">'
            + (f'<ul class="legend">{legend}</ul>' if legend else "")
            + f'<div class="panels">{panels}</div>'
            f"<figcaption>{_text(sheet.caption)}</figcaption></figure>"
        )

    def episodes(self, episodes: Sequence[Episode]) -> None:
        """Adds videos with what was drawn for them."""
        cards = "".join(self._episode(episode) for episode in episodes)
        self._parts.append(f'<div class="panels">{cards}</div>')

    def paper(self, found: Sequence[PaperFigure], num_seeds: int) -> None:
        """Adds the paper's figures, as far as they are there."""
        for figure in found:
            number, title = figure.figure.number, figure.figure.title
            self.heading(f"Figure {number}: {title}")
            self.sheet(figure.sheet, "No run is there yet.")
            wanted = len(figure.counts) * num_seeds
            done = sum(figure.counts.values())
            state = f"{done} of {wanted} runs are finished"
            self._parts.append(
                f"<details><summary>{state}</summary>{_matrix(figure, num_seeds)}"
                + (f"<pre>{_text(figure.command)}</pre>" if figure.command else "")
                + "</details>"
            )

    def html(self) -> bytes:
        """Returns the whole file."""
        links = "".join(f'<a href="#{n}">{_text(t)}</a>' for n, t in self._sections)
        body = "\n".join(self._parts)
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f"{MARK}\n"
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<link rel="icon" href="data:,">\n'
            f"<title>{_text(self._title)}</title>\n<style>{CSS}</style>\n</head>\n"
            f"<body>\n<header><h1>{_text(self._title)}</h1></header>\n"
            f"<nav><div>{links}</div></nav>\n<main>\n{body}\n</main>\n"
            f"<script>{SCRIPT}</script>\n</body>\n</html>\n"
        ).encode()

    def _episode(self, episode: Episode) -> str:
        run, label = episode.run, episode.group.label
        about = f"seed {run.seed}, after {episode.frame:,} frames"
        value = return_at(run, episode.frame)
        if np.isfinite(value):
            about += f"; this evaluation's mean return: {value:.0f}"
        if np.isfinite(run.expert_return):
            about += f", the expert's: {run.expert_return:.0f}"
        video = base64.b64encode(episode.video).decode()
        drawn = "".join(
            f"<h4>{_text(panel.title)}</h4>"
            f"{sheets.inline_svg(panel, next(self._prefixes))}"
            for panel in (episode.sheet.panels if episode.sheet else ())
        )
        return (
            f'<div class="episode"><h4>{_text(f"{episode.group.task}: {label}")}</h4>'
            f"<p>{_text(about)}</p>"
            '<video controls muted loop playsinline preload="auto" '
            f'src="data:video/mp4;base64,{video}"></video>{drawn}</div>'
        )


def _matrix(figure: PaperFigure, num_seeds: int) -> str:
    """Returns a table of tasks and variants: how many seeds of how many."""
    labels = [variant.label for variant in figure.figure.variants]
    head = "".join(f'<th scope="col" class="number">{_text(k)}</th>' for k in labels)
    rows = "".join(_matrix_rows(figure, labels, num_seeds))
    return (
        '<div class="scroll" tabindex="0"><table><thead><tr><th scope="col">finished '
        f"seeds</th>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _matrix_rows(
    figure: PaperFigure, labels: Sequence[str], num_seeds: int
) -> Iterator[str]:
    for task in figures.TASKS:
        cells = []
        for label in labels:
            count, started = figure.counts[task, label], figure.started[task, label]
            kind = "full" if count >= num_seeds else "" if count or started else "none"
            text = f"{count}/{num_seeds}" + (f" + {started} begun" if started else "")
            cells.append(f'<td class="number {kind}" data-sort="{count}">{text}</td>')
        yield f"<tr><td>{task}</td>{''.join(cells)}</tr>"


def _text(text: str) -> str:
    return html.escape(text, quote=True)
