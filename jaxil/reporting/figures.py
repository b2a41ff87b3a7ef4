"""The paper's figures: which runs each of them needs, and what a run is called.

The one place that knows the variants: `launch/sweep.py` makes the runs, and
`jaxil.report` draws them.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

TASKS = (  # in the paper's order
    "cartpole_swingup",
    "finger_spin",
    "ball_in_cup_catch",
    "acrobot_swingup",
    "cheetah_run",
    "walker_stand",
    "walker_walk",
    "walker_run",
)
METHOD_NAMES = {
    "pdac": "P-DAC",
    "psil": "P-SIL",
    "dac": "DAC",
    "sil": "SIL",
    "bc": "BC",
    "drqv2": "DrQ-v2",
    "zero": "no reward",
}
# The paper's hard tasks have 5 million frames in its main results, fewer in ablations.
ABLATION_FRAMES = 3_000_000

# What an ablation may change: the fields that tell runs of one method apart, with the
# value of the method itself and what any other value is called.
_CHANGES: dict[str, tuple[Any, Callable[[Any], str]]] = {
    "demonstrations.num_episodes": (10, lambda n: f"{n} demonstration{'s'[: n != 1]}"),
    "discriminator.sees_actions": (False, lambda _: "actions"),
    "sinkhorn.cost": ("cosine", lambda cost: cost),
    "sinkhorn.alignment": ("transport", lambda _: "not aligned"),
    "shift_padding": (None, lambda _: "no augmentation"),
}
_ONE_METHOD = {"discriminator.sees_actions": "pdac", "sinkhorn.cost": "psil"}
_ONE_METHOD["sinkhorn.alignment"] = "psil"
_WITHOUT_DEMONSTRATIONS = ("drqv2", "zero")


class Variant(NamedTuple):
    """A method with what an ablation changes about it.

    Attributes:
      method: a key of `METHOD_NAMES`.
      overrides: config fields, dotted, with their values; empty for the method itself.
    """

    method: str
    overrides: Mapping[str, Any] = {}

    @property
    def label(self) -> str:
        """What figures and tables call it, such as "P-DAC, no augmentation"."""
        words = [
            name(self.overrides[field])
            for field, (_, name) in _CHANGES.items()
            if field in self.overrides
        ]
        return ", ".join([METHOD_NAMES.get(self.method, self.method), *words])

    @property
    def slug(self) -> str:
        """The same as the name of a folder, such as "pdac_no_augmentation"."""
        words = self.label.split(", ")[1:]
        return "_".join([self.method, *words]).replace(" ", "_")


class Figure(NamedTuple):
    """One figure of the paper.

    Attributes:
      number: in the paper.
      title: what it shows.
      kind: "frames" and "hours": curves of the return over them; "wasserstein":
        curves of the distance to the expert over frames; "bars": the mean over the
        last ten episodes.
      variants: what it compares.
      is_ablation: whether the paper gave it the shorter budget.
    """

    number: int
    title: str
    kind: Literal["frames", "hours", "wasserstein", "bars"]
    variants: tuple[Variant, ...]
    is_ablation: bool


def _product(methods: str, *changes: Mapping[str, Any]) -> tuple[Variant, ...]:
    return tuple(
        Variant(m, change) for m in methods.split() for change in changes or [{}]
    )


_NOT_ALIGNED = {"sinkhorn.alignment": "time"}
_DEMONSTRATIONS = _product(
    "pdac psil bc",
    {"demonstrations.num_episodes": 1},
    {},
    {"demonstrations.num_episodes": 50},
)
_AUGMENTATION = _product("pdac psil bc", {}, {"shift_padding": 0})
_DISTANCES = _product(
    "psil", {}, _NOT_ALIGNED, {**_NOT_ALIGNED, "sinkhorn.cost": "euclidean"}
)
_ACTIONS = _product("pdac", {}, {"discriminator.sees_actions": True})
_ALL = _product("pdac psil dac sil bc")

FIGURES = {
    figure.number: figure
    for figure in (
        Figure(2, "return by frames", "frames", _ALL, False),
        Figure(3, "return by hours", "hours", _product("pdac psil bc"), False),
        Figure(4, "distance to the expert", "wasserstein", _ALL, False),
        Figure(5, "number of demonstrations", "bars", _DEMONSTRATIONS, True),
        Figure(6, "augmentation", "bars", _AUGMENTATION, True),
        Figure(7, "distance between episodes", "bars", _DISTANCES, True),
        Figure(8, "actions of the expert", "bars", _ACTIONS, True),
        Figure(9, "number of demonstrations", "frames", _DEMONSTRATIONS, True),
        Figure(10, "augmentation", "frames", _AUGMENTATION, True),
        Figure(11, "distance between episodes", "frames", _DISTANCES, True),
        Figure(12, "actions of the expert", "frames", _ACTIONS, True),
    )
}


def variant_of(config: Mapping[str, Any]) -> Variant:
    """Returns the variant that a run's config is.

    Args:
      config: nested, as `config.json` holds it. Fields that it lacks, because an
        older jaxil wrote it, have their defaults.
    """
    method = config["method"]
    overrides = {}
    for field, (default, _) in _CHANGES.items():
        value = _read(config, field, default)
        if field == "shift_padding":
            changed = value == 0
        elif field == "demonstrations.num_episodes":
            changed = value != default and method not in _WITHOUT_DEMONSTRATIONS
        else:
            changed = value != default and method == _ONE_METHOD[field]
        if changed:
            overrides[field] = value
    return Variant(method, overrides)


def _read(config: Mapping[str, Any], field: str, default: Any) -> Any:
    value: Any = config
    for part in field.split("."):
        if part not in value:
            return default
        value = value[part]
    return value
