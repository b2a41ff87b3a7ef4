r"""Draws cost.png from cost_*.json beside it: how the cost of a run grows.

    python -m jaxil.benchmark --config=configs/psil.py:cartpole_swingup \
        --sweep=batch_size:32,64,128,256 --json=launch/results/cost_batch_size.json
    python launch/results/draw_cost.py

Each file is one --sweep of the benchmark; `_PANELS` says which field each panel needs.
"""

import json
import pathlib
from typing import Any, NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_HERE = pathlib.Path(__file__).parent
_FRAMES = 1000  # of an episode of the control suite


class _Panel(NamedTuple):
    field: str  # that was swept
    across: str
    metric: str  # of the benchmark
    up: str


_PANELS = (
    _Panel("batch_size", "batch size", "update_ms", "update, ms"),
    _Panel("image_size", "image side, pixels", "update_ms", "update, ms"),
    _Panel(
        "demonstrations.num_episodes",
        "demonstrations",
        "reward_ms",
        "rewarding an episode, ms",
    ),
    _Panel(
        "action_repeat",
        "decisions of an episode",
        "reward_ms",
        "rewarding an episode, ms",
    ),
    _Panel(
        "num_environments",
        "environments",
        "frames_per_second",
        "environment frames per second",
    ),
)


def main() -> None:
    """Draws a panel for each sweep that is there."""
    sweeps: dict[str, list[dict[str, Any]]] = {}
    for path in sorted(_HERE.glob("cost_*.json")):
        results = json.loads(path.read_text())
        sweeps[results[0]["sweep"]["field"]] = results
    panels = [panel for panel in _PANELS if panel.field in sweeps]
    figure = Figure(figsize=(3.4 * len(panels), 3.2), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(grid, panels, strict=True):
        results = sweeps[panel.field]
        x = [_across(panel.field, result["sweep"]["value"]) for result in results]
        y = [result[panel.metric] for result in results]
        low, high = zip(
            *(result["ranges"].get(panel.metric, (None, None)) for result in results),
            strict=True,
        )
        if None not in low:
            axes.fill_between(x, low, high, color="#1f6f8b", alpha=0.15, lw=0)
        axes.plot(x, y, color="#1f6f8b", marker="o", ms=4)
        axes.set_xlabel(panel.across)
        axes.set_ylabel(panel.up)
        axes.set_xticks(x)
        axes.set_ylim(0, 1.1 * max([*y, *(each for each in high if each is not None)]))
        axes.grid(axis="y", alpha=0.25, lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(_setting(results[0]), loc="left", fontsize=8)
    figure.savefig(_HERE / "cost.png")


def _across(field: str, value: float) -> float:
    return _FRAMES / value if field == "action_repeat" else value


def _setting(result: dict[str, Any]) -> str:
    config = result["config"]
    return f"{config['method']}, {config['task']}"


if __name__ == "__main__":
    main()
