"""The paper's figures: which runs each of them compares, and what a run is called.

`jaxil sweep` makes these runs and `jaxil.report` plots them.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

from jaxil import methods
from jaxil.errors import UsageError
from jaxil.files.settings import flat
from jaxil.methods import Method, Variation

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
# The paper's hard tasks have 5 million frames in its main results, fewer in ablations.
ABLATION_FRAMES = 3_000_000

DEMONSTRATIONS = "demonstrations.num_episodes"
_DEMONSTRATIONS_VARIATION = Variation(DEMONSTRATIONS, 10, "{} demonstrations")
_AUGMENTATION_VARIATION = Variation("shift_padding", 4, "no augmentation")
_MAX_SLUG = 200  # bytes; file systems take 255


class Variant(NamedTuple):
    """A method with what an ablation changes about it."""

    method: str  # known or not
    overrides: Mapping[str, Any] = {}  # values by dotted config field

    @property
    def label(self) -> str:
        """Its name in figures and tables, such as "P-DAC, no augmentation"."""
        return ", ".join([declaration(self.method).label, *self._words()])

    @property
    def slug(self) -> str:
        """Its name as a folder, such as "pdac_no_augmentation"."""
        text = "_".join([self.method, *self._words()])
        slug = re.sub(r"[^\w.-]+", "_", text)
        return slug.encode()[:_MAX_SLUG].decode(errors="ignore")

    def _words(self) -> Iterator[str]:
        for variation in _variations(self.method):
            if variation.field not in self.overrides:
                continue
            value = self.overrides[variation.field]
            is_single = variation.field == DEMONSTRATIONS and value == 1
            yield "1 demonstration" if is_single else variation.words.format(value)


class Figure(NamedTuple):
    """One figure of the paper."""

    number: int
    title: str
    # Curves of the return over frames or hours, or of the distance to the expert over
    # frames; bars: the mean over the last ten episodes.
    kind: Literal["frames", "hours", "wasserstein", "bars"]
    variants: tuple[Variant, ...]
    has_short_budget: bool  # as the paper's ablations: ABLATION_FRAMES


class Study(NamedTuple):
    """What one name of `jaxil sweep --ablation` trains."""

    variants: tuple[Variant, ...]
    has_short_budget: bool  # as the paper's ablations: ABLATION_FRAMES


def _product(names: str, *changes: Mapping[str, Any]) -> tuple[Variant, ...]:
    return tuple(
        Variant(name, change) for name in names.split() for change in changes or [{}]
    )


_NOT_ALIGNED = {"sinkhorn.alignment": "time"}
_NUMBERS = ({DEMONSTRATIONS: 1}, {}, {DEMONSTRATIONS: 50})
_DEMONSTRATIONS = _product("pdac psil bc", *_NUMBERS)
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


def studies() -> dict[str, Study]:
    """Returns what `jaxil sweep --ablation` offers, by name.

    Those are the paper's figures, and `video_alone`: every method that plays and needs
    no actions, from 1, 10 and 50 demonstrations.
    """
    alone = [
        name
        for name, method in methods.known().items()
        if method.plays
        and method.uses_demonstrations
        and method.sees_actions is not True
    ]
    paper = {
        f"figure{number}": Study(figure.variants, figure.has_short_budget)
        for number, figure in FIGURES.items()
    }
    return {**paper, "video_alone": Study(_product(" ".join(alone), *_NUMBERS), True)}


def declaration(name: str) -> Method:
    """Returns a method's declaration; of one that is not installed, its name only."""
    return installed(name) or Method(name=name, label=name, about="not installed here")


def variant_of(config: Mapping[str, Any]) -> Variant:
    """Returns the variant that a run's config, nested as in `config.json`, makes.

    Fields that it lacks, because an older jaxil wrote it, have their defaults.
    """
    overrides, stored = {}, flat(config)
    for field, plain, _ in _variations(config["method"]):
        value = stored.get(field, plain)
        value = tuple(value) if isinstance(value, list) else value
        # Another padding than 0 is a setting, not an ablation.
        changed = value == 0 if field == "shift_padding" else value != plain
        if changed:
            overrides[field] = value
    return Variant(config["method"], overrides)


def installed(name: str) -> Method | None:
    """Returns a method's declaration, if it can be read."""
    # Names come from files of runs: nothing is imported that only they name.
    if not methods.is_trusted(name):
        return None
    try:
        return methods.get(name)
    except UsageError:
        return None


def _variations(method: str) -> list[Variation]:
    declared = declaration(method)
    demonstrations = [_DEMONSTRATIONS_VARIATION] * declared.uses_demonstrations
    return [*demonstrations, *declared.variations, _AUGMENTATION_VARIATION]
