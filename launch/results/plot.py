r"""Plots overview.png from RUN/eval.csv, and cost.png from cost_*.json.

    python -m jaxil.benchmark --config=configs/psil.py:cartpole_swingup \
        --sweep=batch_size:32,64,128,256 --json=launch/results/cost_batch_size.json
    python launch/results/plot.py

All lie beside this file. The overview has a panel for each task and every run in it.
"""

import collections
import json
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxil import methods
from jaxil.config import default_config
from jaxil.files.tables import read_csv
from jaxil.presets import tiny
from jaxil.reporting.figures import TASKS

_HERE = pathlib.Path(__file__).parent
_EPISODE_FRAMES = 1000
_DEMONSTRATIONS = 10  # whose return is the expert's
# Field that was swept: x label, row of the benchmark, y label.
_REWARD = ("reward_ms", "rewards of an episode, ms")
_PANELS = {
    "batch_size": ("batch size", "update_ms", "update, ms"),
    "image_size": ("image side, pixels", "update_ms", "update, ms"),
    "demonstrations.num_episodes": ("demonstrations", *_REWARD),
    "action_repeat": ("agent steps of an episode", *_REWARD),
    "num_environments": ("environments", "frames_per_second", "frames per second"),
}


class Kind(NamedTuple):
    """How the overview plots runs of one kind."""

    label: str
    colour: str
    style: str = "-"
    width: float = 1.0


_KINDS = {
    "pdac": Kind("P-DAC, today's small preset", "#0072B2", width=2.2),
    "psil": Kind("P-SIL, today's small preset", "#D55E00", width=2.2),
    "laifo": Kind("LAIfO, today's small preset", "#882255", width=2.2),
    "pdac, changed": Kind("P-DAC, other settings", "#56B4E9"),
    "psil, changed": Kind("P-SIL, other settings", "#E69F00"),
    "drqv2": Kind("true reward", "#009E73"),
    "state": Kind("imitation from state vectors", "#999999", "--"),
    "other": Kind("experiments and controls", "#cccccc"),
}
# Words in the names of runs that were made with changed code.
_EXPERIMENTS = {"pca32", "pca64", "dynamics", "cloning1", "cloning3", "cloning10"}
_EXPERIMENTS |= {"beside", "layernorm", "centred", "std10k", "greedy", "reconstruction"}
_EXPERIMENTS |= {"switched", "temporal", "inverse", "transitions", "twojudges"}
_EXPERIMENTS |= {"pretrained", "rescaled", "decision", "differences"}
_EXPERIMENTS |= {"lowrate", "scaled", "gradients", "nstep3", "decay"}
_EXPERIMENTS |= {"noaug", "demos1", "demos50", "actions", "time"}  # of the claims
# Fields that do not change what a run learns.
_INCIDENTAL = {"seed", "total_frames", "num_eval_episodes", "eval_every_frames"}
_INCIDENTAL |= {"checkpoint_every_frames", "video_every_evals", "policy_tau"}


def kind_of(name: str, config: Mapping[str, Any]) -> str:
    """Returns the kind of a run, by its folder and its settings."""
    method = config["method"]
    is_known = method in methods.known()
    if _EXPERIMENTS & set(name.split("_")) or (is_known and method not in _KINDS):
        return "other"
    if config.get("observation", "pixels") == "state":
        return "state"
    if not is_known:  # P-DAC on components, before that was a field
        return "pdac, changed"
    if method == "drqv2" or is_of_preset(config):
        return method
    changed = f"{method}, changed"
    return changed if changed in _KINDS else "other"


def is_of_preset(config: Mapping[str, Any]) -> bool:
    """Returns whether a run was made with what is the small preset today.

    Fields that its version did not have are taken for their defaults.
    """
    method, task = config["method"], config["task"]
    preset = _flat(tiny.get_config(f"{method},{task}").to_dict())
    fields = _flat(default_config(method, task).to_dict()) | _flat(config)
    return all(fields[name] == value for name, value in preset.items())


def _flat(fields: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns the fields of all sections by full name, without incidental ones."""
    found = {}
    for name, value in fields.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        elif name not in _INCIDENTAL:
            # JSON has no tuples.
            found[prefix + name] = list(value) if isinstance(value, tuple) else value
    return found


def plot_overview() -> None:
    """Plots a panel for each task: every run, coloured by its kind."""
    runs, experts = collections.defaultdict(list), collections.defaultdict(list)
    for path in sorted(_HERE.glob("*/eval.csv")):
        config = json.loads((path.parent / "config.json").read_text())["config"]
        kind, table = kind_of(path.parent.name, config), read_csv(path)
        if len(table["frame"]):  # some ended before an evaluation
            task = config["task"]
            runs[task].append((list(_KINDS).index(kind), kind, table))
            if config["demonstrations"]["num_episodes"] == _DEMONSTRATIONS:
                experts[task].append(table["expert_task_return_mean"][-1])
    panels = _axes(2, 4, width=3.0, height=2.5)
    for axes, task in zip(panels, TASKS):
        for _, kind, table in sorted(runs[task], key=lambda run: -run[0]):
            label, colour, style, width = _KINDS[kind]
            x, y = table["frame"] / 1000, table["task_return_mean"]
            marker = "" if len(x) > 1 else "o"
            look = {"color": colour, "lw": width, "marker": marker, "ms": 3}
            axes.plot(x, y, style, label=label, **look)
        if experts[task]:  # the first runs had worse ones
            expert = np.nanmax(experts[task])
            axes.axhline(expert, color="#222222", ls=":", lw=1.2, label="expert")
        else:
            words = {"ha": "center", "va": "center", "color": "#777777"}
            axes.text(0.5, 0.5, "no evaluation yet", transform=axes.transAxes, **words)
        axes.set_title(task, fontsize=9)
        axes.set(xlim=(0, None), ylim=(0, 1050))
        axes.tick_params(labelsize=7)
    for axes in panels[4:]:
        axes.set_xlabel("environment frames / 1000", fontsize=8)
    for axes in panels[::4]:
        axes.set_ylabel("task return", fontsize=8)
    lines = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        lines.update(zip(labels, handles))
    order = [kind.label for kind in _KINDS.values() if kind.label in lines]
    order += ["expert"]
    place = {"loc": "outside lower center", "ncols": 4, "frameon": False}
    figure = panels[0].figure
    figure.legend([lines[label] for label in order], order, fontsize=8, **place)
    figure.savefig(_HERE / "overview.png")


def plot_cost() -> None:
    """Plots a panel for each sweep of the benchmark: median and range."""
    found = [json.loads(path.read_text()) for path in _HERE.glob("cost_*.json")]
    sweeps = {results[0]["sweep"]["field"]: results for results in found}
    fields = [field for field in _PANELS if field in sweeps]
    for axes, field in zip(_axes(1, len(fields), width=3.4, height=3.2), fields):
        results, (xlabel, row, ylabel) = sweeps[field], _PANELS[field]
        x = [result["sweep"]["value"] for result in results]
        if field == "action_repeat":
            x = [_EPISODE_FRAMES / repeat for repeat in x]
        if row in results[0]["ranges"]:
            low, high = zip(*(result["ranges"][row] for result in results))
            axes.fill_between(x, low, high, alpha=0.15)
        axes.plot(x, [result[row] for result in results], "o-")
        config = results[0]["config"]
        axes.set_title(f"{config['method']}, {config['task']}", fontsize=8)
        axes.set(xlabel=xlabel, ylabel=ylabel, xticks=x)
        axes.set_ylim(0, 1.05 * axes.get_ylim()[1])
        axes.figure.savefig(_HERE / "cost.png")


def _axes(rows: int, columns: int, *, width: float, height: float) -> list:
    size = (width * columns, height * rows)
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels:
        axes.grid(axis="y", alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    return panels


if __name__ == "__main__":
    plot_overview()
    plot_cost()
