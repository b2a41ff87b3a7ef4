"""One look for each variant, the same in every figure: colour, line, marker."""

import colorsys
from collections.abc import Iterable
from typing import Any, NamedTuple

from jaxil.reporting import figures
from jaxil.reporting.groups import Group, label_order

# Okabe and Ito's palette, told apart also by colour-blind readers.
_COLOURS = {
    "pdac": "#0072B2",
    "psil": "#D55E00",
    "dac": "#56B4E9",
    "sil": "#E69F00",
    "bc": "#009E73",
    "drqv2": "#CC79A7",
    "zero": "#888888",
}
# Lines of one method: their dashes in line widths, marker, and lightness beside it.
# Five and six have no common factor: thirty lines differ.
_DASHES = ((), (4.0, 1.5), (1.0, 1.3), (5.0, 1.5, 1.0, 1.5), (7.0, 2.0), (2.5, 1.0))
_MARKERS = ("o", "s", "^", "D", "v", "P")
_LIGHTNESS = (0.0, 0.17, -0.07, 0.25, 0.09)
_DARKEST = 0.27  # still seen on a dark page
# Stands for the page's text colour, which is light on dark pages.
INK = "#1b1c1e"


class Look(NamedTuple):
    """How a variant is drawn.

    Attributes:
      colour: as "#rrggbb".
      dashes: lengths on and off, in line widths; empty for a solid line.
      marker: of single points, in Matplotlib's letters.
    """

    colour: str
    dashes: tuple[float, ...]
    marker: str

    @property
    def line(self) -> Any:
        """The dashes as Matplotlib's line style."""
        return (0, self.dashes) if self.dashes else "-"


def looks(groups: Iterable[Group]) -> dict[str, Look]:
    """Returns the look of each label; the methods' own colours, always the same."""
    ordered: dict[str, Group] = {}
    for group in sorted(groups, key=label_order):
        ordered.setdefault(group.label, group)
    found: dict[str, Look] = {}
    for method in figures.METHOD_NAMES:
        labels = [k for k, group in ordered.items() if group.variant.method == method]
        for place, label in enumerate(labels):
            found[label] = Look(
                _shade(_COLOURS[method], _LIGHTNESS[place % len(_LIGHTNESS)]),
                _DASHES[place % len(_DASHES)],
                _MARKERS[place % len(_MARKERS)],
            )
    return found


def _shade(colour: str, change: float) -> str:
    channels = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    hue, lightness, saturation = colorsys.rgb_to_hls(*channels)
    lightness = min(max(lightness + change, _DARKEST), 0.85)
    rgb = colorsys.hls_to_rgb(hue, lightness, saturation)
    return "#" + "".join(f"{round(255 * channel):02x}" for channel in rgb)
