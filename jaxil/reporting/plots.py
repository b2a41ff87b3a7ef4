"""Plots one panel: curves, bars, logits, an episode's rewards, a transport plan."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import PowerNorm
from matplotlib.ticker import EngFormatter, MaxNLocator

from jaxil.reporting.groups import Group
from jaxil.reporting.measures import Curve
from jaxil.reporting.statistics import Estimate

# Becomes the page's text colour, which is light on dark pages.
INK = "#1b1c1e"
_MAX_MARKED = 40  # points; a longer curve has no markers
_BAR_LINES = 2.8  # height of a bar with its label, in lines of text
_LINE_HEIGHT = 0.145  # inches
# Left and right of the axes, in inches.
BAR_MARGINS, REWARD_MARGINS = (0.1, 0.2), (0.72, 0.62)
# Intervals are cut off beyond this many times the height of the means.
_BAND_ROOM = 1.25
_NAME_ROOM = 0.07  # share of the axis for the name of a dashed line
# Of an alignment: the most lines, the height of a film strip as a share of the axes,
# and the widths of lines for the shares 0 and 1.
_MAX_MATCHES, _STRIP, _LINE_WIDTHS = 60, 0.27, (0.25, 2.5)


def curves(
    axes: Axes,
    lines: Sequence[Curve],
    *,
    levels: Sequence[tuple[float, str]] = (),
    name: str,
) -> None:
    """Plots the mean of each group with its interval, over frames or over hours.

    A dashed line marks each of `levels`, (height, its name), which fall; `name` is that
    of the vertical axis.
    """
    for line in lines:
        _line(axes, line)
    heights = [line.mean.value for line in lines] + [[value for value, _ in levels]]
    bands = [end for line in lines for end in line.mean[1:]]
    bottom, top = _vertical(np.concatenate(heights), np.concatenate(bands))
    axes.set_ylim(bottom, top)
    named = np.inf
    for value, text in levels:
        axes.axhline(value, color=INK, ls=(0, (4, 3)), lw=0.9, alpha=0.75, zorder=1)
        if named - value < _NAME_ROOM * (top - bottom):
            continue  # its name would cover the one above
        named = value
        axes.annotate(
            text,
            (0.995, value),
            xycoords=("axes fraction", "data"),
            xytext=(0, 2),
            textcoords="offset points",
            ha="right",
            va="bottom",
            fontsize=7.5,
            alpha=0.85,
        )
    _horizontal(axes, lines)
    axes.set_ylabel(name)
    axes.grid(axis="y", alpha=0.16, lw=0.6, color=INK)


class Bar(NamedTuple):
    """One bar."""

    group: Group  # gives it name and colour
    values: np.ndarray  # a dot each. Shape [S], S >= 1
    estimate: Estimate  # its length, and the interval
    is_hatched: bool = False  # such as for unfinished runs


def bars(
    axes: Axes, rows: Sequence[Bar], *, levels: Sequence[float] = (), name: str
) -> None:
    """Plots bars from top to bottom.

    A dashed line marks each of `levels`; `name` is that of the horizontal axis.
    """
    highest = max([1.0, *levels, *(float(bar.values.max()) for bar in rows)])
    # The interval of two seeds can be many times as long as their bar.
    ends = np.minimum([bar.estimate.high for bar in rows], _BAND_ROOM * highest)
    highest = float(np.nanmax([highest, *ends]))
    for row, bar in enumerate(rows):
        colour = bar.group.look.colour
        y = _BAR_LINES * (row + 0.68)
        text_y = _BAR_LINES * (row + 0.36)
        axes.text(0, text_y, bar.group.label, fontsize=8, va="bottom")
        mean, low, high = map(float, bar.estimate)
        axes.barh(
            y,
            mean,
            height=1.1,
            color=colour,
            alpha=0.88,
            lw=0,
            hatch="////" if bar.is_hatched else None,
            edgecolor="#ffffff88",
        )
        if np.isfinite(high):
            axes.plot([low, min(high, highest)], [y, y], color=INK, lw=1.3, zorder=4)
        dots = {"ls": "", "marker": "o", "ms": 3.6, "mew": 0.8, "zorder": 5}
        heights = np.full(len(bar.values), y)
        axes.plot(bar.values, heights, mfc=colour, mec=INK, **dots)
        top = float(np.nanmax([mean, high, bar.values.max()]))
        axes.annotate(
            f"{mean:.0f}",
            (min(max(top, 0.0), highest), y),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
        )
    for level in levels:
        axes.axvline(level, color=INK, ls=(0, (4, 3)), lw=0.9, alpha=0.75, zorder=1)
    lowest = min(0.0, *(float(bar.values.min()) for bar in rows))
    axes.set_xlim(lowest, 1.12 * highest)
    axes.set_ylim(_BAR_LINES * len(rows), 0)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.set_xlabel(name)


def bars_height(rows: int) -> float:
    """Returns the height of a panel of bars, in inches."""
    return 0.6 + _LINE_HEIGHT * _BAR_LINES * rows


def logits(axes: Axes, pairs: Sequence[tuple[Curve, Curve]]) -> None:
    """Plots the discriminator's logits of expert (solid) and agent (dotted)."""
    for expert, agent in pairs:
        colour = expert.group.look.colour
        axes.plot(expert.x, expert.mean.value, color=colour, lw=1.4)
        axes.plot(agent.x, agent.mean.value, color=colour, lw=1.4, ls=(0, (1, 1.2)))
    axes.axhline(0.0, color=INK, lw=0.7, alpha=0.5)
    _horizontal(axes, [expert for expert, _ in pairs])
    axes.set_ylabel("mean logit")
    axes.grid(axis="y", alpha=0.16, lw=0.6, color=INK)


class Filmed(NamedTuple):
    """What a filmed episode of T agent steps has beside its pictures, if anything."""

    imitation_rewards: np.ndarray = np.zeros(0)  # what the agent learns from. Shape [T]
    task_rewards: np.ndarray = np.zeros(0)  # which it never sees. Shape [T]
    plan: np.ndarray = np.zeros((0, 0))  # of transport, >= 0. Shape [T + 1, N + 1]
    # Evenly spaced frames from first to last, uint8 [n, H, W, 3].
    agent_strip: np.ndarray = np.zeros((0, 0, 0, 3))
    expert_strip: np.ndarray = np.zeros((0, 0, 0, 3))
    step_seconds: float | np.ndarray = 0.0  # of an agent step; 0 if unknown

    @property
    def shares(self) -> np.ndarray:
        """The share of each agent frame's mass that goes where: rows sum to 1."""
        return self.plan / np.maximum(self.plan.sum(axis=1, keepdims=True), 1e-12)

    @property
    def step(self) -> float:
        """The length of an agent step on a time axis."""
        return float(self.step_seconds) or 1.0

    def time_axis(self, whose: str) -> str:
        """Returns the name of a time axis."""
        return f"{whose}{', seconds' if self.step_seconds else ' step'}"


def rewards(axes: Axes, filmed: Filmed, colour: str) -> None:
    """Plots the rewards of one episode; those of imitation in a colour."""
    imitation, task, step = filmed.imitation_rewards, filmed.task_rewards, filmed.step
    times = step * np.arange(max(len(imitation), len(task)))
    axes.plot(times[: len(imitation)], imitation, color=colour, lw=1.1)
    axes.set_ylabel("imitation reward", color=colour)
    axes.set_xlim(0, step * max(len(imitation), 2))
    axes.set_xlabel(filmed.time_axis("agent"))
    if np.isfinite(task).any():
        other = axes.twinx()
        other.plot(times[: len(task)], task, color=INK, lw=0.9, alpha=0.6)
        other.set_ylabel("task reward")
        other.set_ylim(min(0.0, float(np.nanmin(task))))
        other.spines[["top", "left"]].set_visible(False)


def plan(axes: Axes, filmed: Filmed) -> None:
    """Plots a transport plan: which expert frames each agent frame is matched with."""
    shares, step = filmed.shares, filmed.step
    image = axes.imshow(
        shares.T,
        origin="lower",
        aspect="auto",
        cmap="magma",
        norm=PowerNorm(0.5, vmin=0.0, vmax=float(shares.max())),
        interpolation="nearest",
        extent=(0, step * shares.shape[0], 0, step * shares.shape[1]),
    )
    axes.set_xlabel(filmed.time_axis("agent"))
    axes.set_ylabel(filmed.time_axis("expert"))
    scale = axes.inset_axes((1.025, 0, 0.03, 1))
    axes.figure.colorbar(image, cax=scale).set_label("share", labelpad=2)


def alignment(axes: Axes, filmed: Filmed) -> None:
    """Plots a transport plan as lines between the two film strips.

    Each of evenly spaced agent frames has a line to the expert frame that receives
    most of its mass; the width shows that share, the colour the agent's time.
    """
    shares, step = filmed.shares, filmed.step
    ends = [step * size for size in shares.shape]
    strips = (filmed.agent_strip, filmed.expert_strip)
    for strip, end, low in zip(strips, ends, (1.0 - _STRIP, 0.0)):
        extent = (0, end, low, low + _STRIP)
        axes.imshow(np.concatenate([*strip], axis=1), extent=extent, aspect="auto")
    rows = np.linspace(0, len(shares) - 1, min(_MAX_MATCHES, len(shares))).round()
    rows = rows.astype(int)
    columns = shares[rows].argmax(axis=1)
    pairs = zip(rows, columns)
    lines = [[(step * r, 1.0 - _STRIP), (step * c, _STRIP)] for r, c in pairs]
    widths = np.interp(shares[rows, columns], (0.0, 1.0), _LINE_WIDTHS)
    colours = colormaps["viridis"](rows / len(shares))
    axes.add_collection(LineCollection(lines, linewidths=widths, colors=colours))
    axes.set_xlim(0, max(ends))
    axes.set_ylim(0, 1)
    axes.set_yticks([_STRIP / 2, 1 - _STRIP / 2], ["expert", "agent"])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel(filmed.time_axis("").strip(" ,"))


def _line(axes: Axes, line: Curve) -> None:
    look = line.group.look
    marker = look.marker if len(line.x) <= _MAX_MARKED else None
    mean, low, high = line.mean
    whole = line.count == line.num_runs
    axes.fill_between(line.x, low, high, color=look.colour, alpha=0.17, lw=0)
    style = {"color": look.colour, "ls": look.line, "marker": marker, "ms": 2.8}
    axes.plot(line.x, np.where(whole, mean, np.nan), lw=1.7, zorder=3, **style)
    # Faint where seeds are missing, since the mean jumps as they drop out; drawn up to
    # the next points of the full line, so that both meet.
    beside = np.convolve(~whole, [1, 1, 1])[1:-1] > 0
    if beside.any():
        faint = np.where(beside, mean, np.nan)
        axes.plot(line.x, faint, lw=1.3, alpha=0.45, zorder=2, **style)


def _vertical(heights: np.ndarray, bands: np.ndarray) -> tuple[float, float]:
    """Returns the ends of an axis with zero, all heights and most of the bands."""
    heights, bands = heights[np.isfinite(heights)], bands[np.isfinite(bands)]
    low, high = min(0.0, float(heights.min())), max(0.0, float(heights.max()))
    size = max(high - low, 1e-3)
    # The interval of two seeds can be many times as high as their curve.
    room = (_BAND_ROOM - 1.0) * size
    top = max(high, min(float(bands.max(initial=high)), high + room))
    bottom = low
    if low < 0:
        bottom = min(low, max(float(bands.min(initial=low)), low - room)) - 0.04 * size
    return bottom, top + 0.08 * size


def _horizontal(axes: Axes, lines: Sequence[Curve]) -> None:
    right = max(float(line.x[-1]) for line in lines)
    axes.set_xlim(0, 1.02 * right if right > 0 else 1.0)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    if lines[0].over == "frame":
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_xlabel("environment frames")
    else:
        axes.set_xlabel("hours")
