r"""Draws learning.png from the evaluations beside it: RUN/eval.csv, RUN/config.json.

python launch/results/draw.py
"""

import json
import pathlib

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from jaxil.files.tables import read_csv

_HERE = pathlib.Path(__file__).parent
_COLOURS = {"pdac": "#1f6f8b", "psil": "#c8553d", "drqv2": "#588157", "zero": "#777777"}
_STYLES = {2: "-", 4: "--", 8: "-."}  # by action repeat
_PENALTY = 10.0  # the discriminator's, in the paper
# In the names of runs that only the code tells apart, which was older or newer.
_SAME_SETTINGS = {"again": "-.", "native": "-", "winograd": ":", "quickstart": "-"}
_COLUMNS = 2
_NAMES = {"pdac": "P-DAC", "psil": "P-SIL", "drqv2": "true reward", "zero": "no reward"}


def main() -> None:
    """Draws a panel or two for each task, one line for each run."""
    runs: dict[str, list[tuple[str, dict, dict]]] = {}
    for path in sorted(_HERE.glob("*/eval.csv")):
        config = json.loads((path.parent / "config.json").read_text())["config"]
        run = (path.parent.name, config, read_csv(path))
        runs.setdefault(_panel(config), []).append(run)
    rows = -(-len(runs) // _COLUMNS)
    size = (5.2 * _COLUMNS, 5.2 * rows)
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for axes in panels[len(runs) :]:
        axes.set_axis_off()
    for axes, (task, task_runs) in zip(panels, sorted(runs.items()), strict=False):
        experts = [table["expert_task_return_mean"][-1] for *_, table in task_runs]
        expert = max(experts)
        axes.axhline(expert, color="#444444", ls="--", lw=1.2, label="expert")
        axes.axhline(0.8 * expert, color="#444444", ls=":", lw=1.0, label="80 % of it")
        for name, config, table in task_runs:
            axes.plot(
                table["frame"],
                table["task_return_mean"],
                color=_COLOURS[config["method"]],
                alpha=1.0 if config["seed"] == 0 else 0.55,
                ls=_style(name, config),
                # Runs that got nowhere stay in the background.
                lw=1.8 if max(table["task_return_mean"]) >= 0.8 * expert else 0.8,
                marker="o",
                ms=2.5,
                label=_label(name, config),
            )
        axes.set_title(task, loc="left", fontsize=11)
        axes.set_xlim(left=0)
        axes.set_ylim(0, 1050)
        axes.set_xlabel("environment frames")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(axis="y", alpha=0.25, lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.16),
            ncols=1,  # two would reach into the next panel
            frameon=False,
            fontsize=7,
        )
    panels[0].set_ylabel("task return, mean of 10 episodes")
    figure.savefig(_HERE / "learning.png")


def _panel(config: dict) -> str:
    penalty = config["discriminator"]["gradient_penalty"]
    is_preset = penalty != _PENALTY and config["observation"] == "pixels"
    if config["task"] == "cartpole_swingup" and is_preset:
        return "cartpole_swingup, P-DAC's preset"
    return config["task"]


def _style(name: str, config: dict) -> str:
    if config["observation"] == "state":
        return ":"
    for word, style in _SAME_SETTINGS.items():
        if word in name.split("_"):
            return style
    return _STYLES[config["action_repeat"]]


def _label(name: str, config: dict) -> str:
    parts = [
        _NAMES[config["method"]],
        f"repeat {config['action_repeat']}",
        f"replay {config['replay_size_steps'] // 1000}k",
        f"seed {config['seed']}",
    ]
    if config["observation"] == "state":
        parts.append("state vector")
    if config["render_quality"] == "smooth":
        parts.append("smooth")
    penalty = config["discriminator"]["gradient_penalty"]
    if penalty != _PENALTY:
        parts.append(f"penalty {penalty:g}")
    parts += [word for word in _SAME_SETTINGS if word in name.split("_")]
    return ", ".join(parts)


if __name__ == "__main__":
    main()
