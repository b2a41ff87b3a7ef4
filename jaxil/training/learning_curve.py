"""Plots a run's task return over environment frames."""

import io
import os

import numpy as np

from jaxil.files.tables import read_csv
from jaxil.files.writing import write_atomically

_COLOUR = "#1f6f8b"


def plot(
    path: str | os.PathLike,
    eval_csv: str | os.PathLike,
    *,
    title: str,
    expert_return: float | None = None,
) -> None:
    """Plots the evaluations of a run, and the expert's mean return, as a PNG.

    Raises:
      OSError: the table cannot be read or the picture cannot be written.
    """
    # Not pyplot: a Figure needs no display and leaves no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    table = read_csv(eval_csv)
    frames, mean = table["frame"], table["task_return_mean"]
    spread = np.nan_to_num(table["task_return_std"])
    figure = Figure(figsize=(6.4, 3.8), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set(xlabel="environment frames", ylabel="task return")
    axes.set_title(title, loc="left", fontsize=11)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.25, lw=0.6)
    if expert_return is not None:
        label = f"expert, {expert_return:.0f}"
        axes.axhline(expert_return, color="#444444", ls="--", lw=1.2, label=label)
    if len(frames):
        axes.fill_between(
            frames, mean - spread, mean + spread, color=_COLOUR, alpha=0.18, lw=0
        )
        # Dots while there are few, so that a single evaluation is visible.
        dots = "o" if len(frames) <= 40 else None
        label = f"agent, {mean[-1]:.0f} at the end (band: std over episodes)"
        axes.plot(frames, mean, color=_COLOUR, lw=1.8, marker=dots, ms=3.5, label=label)
        # Below the axes, where no curve can cross it.
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8.5)
    axes.set_xlim(left=0)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    write_atomically(path, picture.getvalue())
