"""What a sweep is made of: each run's folder, settings and command."""

import dataclasses
import os
import pathlib
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from jaxil import command
from jaxil.config import Config, default_config, unknown_name
from jaxil.reporting import figures
from jaxil.training import workdir
from launch.sweeps.faults import Faults, Faulty

ROOT = pathlib.Path(__file__).resolve().parents[2]
PRESETS = ("paper", "tiny")
_FIGURES = {f"figure{number}": figure for number, figure in figures.FIGURES.items()}
# What the sweep itself says about each run.
_OWN_FLAGS = {"seed": "--seeds", "task": "--tasks", "method": "--methods"}


class Run(NamedTuple):
    """One run, as the worker that trains it has to know it.

    Attributes:
      task: a dm_control `domain_task`.
      slug: of the variant.
      method: of the variant.
      seed: >= 0.
      folder: where it lives, DIR/TASK/SLUG/seedN.
      total_frames: its budget, in environment frames.
      command: the command line that trains it, or goes on with it.
    """

    task: str
    slug: str
    method: str
    seed: int
    folder: pathlib.Path
    total_frames: int
    command: tuple[str, ...]

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.task}/{self.slug}/seed{self.seed}"


@dataclasses.dataclass(frozen=True)
class Request:
    """What the user asked for, unchecked.

    Attributes:
      methods: plain variants.
      ablations: such as "figure7".
      tasks: dm_control `domain_task`s.
      num_seeds: seeds 0, 1, ... of each.
      preset: one of `PRESETS`.
      folder: of the sweep.
      overrides: words "--config.FIELD=VALUE", for all runs.
    """

    methods: Sequence[str]
    ablations: Sequence[str]
    tasks: Sequence[str]
    num_seeds: int
    preset: str
    folder: pathlib.Path
    overrides: Sequence[str]


class _Choice(NamedTuple):
    variant: figures.Variant
    has_short_budget: bool


def make_runs(
    request: Request, config_problems: Callable[[Config], list[str]]
) -> list[Run]:
    """Returns all runs: seed 0 of everything first, so that early results compare.

    Args:
      request: what to run.
      config_problems: as `jaxil.training.assembly.problems`.

    Raises:
      Faulty: names every fault of every run, each once.
    """
    faults = Faults()
    for sentence in _request_problems(request):
        faults.add(sentence)
    # Without any method, one stands in, so that faults of tasks are told as well.
    choices = _choices(request) or [_Choice(figures.Variant("drqv2"), False)]
    runs: list[list[Run]] = []
    groups = [(task, choice) for task in request.tasks for choice in choices]
    for task, choice in groups:
        where = f"{task}/{choice.variant.slug}"
        config, words = _configured(request, task, choice, faults, where)
        if config is None:
            continue
        for sentence in config_problems(config):
            faults.add(sentence, where)
        runs.append(list(_seeds(request, config, words)))
    for group in runs if not faults else []:
        _check_folders(group, request.folder, faults)
    if faults:
        everywhere = {f"{task}/{choice.variant.slug}" for task, choice in groups}
        raise Faulty(faults.sentences(everywhere))
    return [run for seed in zip(*runs, strict=True) for run in seed]


def read_config(words: Sequence[str]) -> Config:
    """Returns the config that `jaxil.launch` would make of a command's words.

    Raises:
      UsageError: as `jaxil.launch` would.
    """
    argv = ["sweep", *(word for word in words if word.startswith("--config"))]
    return command.parse(argv, "", command.define_config).config


def _request_problems(request: Request) -> Iterator[str]:
    if not request.methods and not request.ablations:
        yield "--methods is missing: name some, such as --methods=pdac,psil"
    if request.preset not in PRESETS:
        yield unknown_name("--preset", request.preset, PRESETS)
    known = _known_methods(request.preset)
    for method in request.methods:
        if method not in known:
            yield unknown_name("--methods", method, known)
    for ablation in request.ablations:
        if ablation not in _FIGURES:
            yield unknown_name("--ablation", ablation, tuple(_FIGURES))
    if not request.tasks:
        yield "--tasks is empty: name some, or leave it out for the paper's eight"
    if request.num_seeds < 1:
        yield f"--seeds={request.num_seeds} must be at least 1: it is their number"
    if (request.folder / "config.json").exists():
        yield (
            f"--workdir={str(request.folder)!r} is the folder of a single run: name "
            "another for the sweep"
        )
    else:
        yield from workdir.problems(request.folder, default_config())
    for word in request.overrides:
        field = _field(word)
        if field in _OWN_FLAGS:
            yield f"{word} is what the sweep itself sets: use {_OWN_FLAGS[field]}"


def _known_methods(preset: str) -> tuple[str, ...]:
    """Returns the methods that have a config file; one of tiny.py's serves all."""
    return tuple(
        method
        for method in figures.METHOD_NAMES
        if preset != "paper" or (ROOT / "configs" / f"{method}.py").is_file()
    )


def _choices(request: Request) -> list[_Choice]:
    """Returns the union of what methods and figures ask for, in their order."""
    known = _known_methods(request.preset)
    methods = [method for method in request.methods if method in known]
    named = [_Choice(figures.Variant(method), False) for method in methods]
    for figure in (_FIGURES[a] for a in request.ablations if a in _FIGURES):
        named += [_Choice(variant, figure.is_ablation) for variant in figure.variants]
    union: dict[str, _Choice] = {}
    for choice in named:
        before = union.setdefault(choice.variant.slug, choice)
        # A run that serves two figures has the longer one's budget.
        short = before.has_short_budget and choice.has_short_budget
        union[choice.variant.slug] = _Choice(choice.variant, short)
    return list(union.values())


def _configured(
    request: Request, task: str, choice: _Choice, faults: Faults, where: str
) -> tuple[Config, list[str]]:
    """Returns config and flags of a task's variant; None as config if it has none."""
    variant = choice.variant
    words = [f"--config={_config_file(request.preset, variant.method, task)}"]
    words += request.overrides
    words += [f"--config.{name}={value}" for name, value in variant.overrides.items()]
    given = {_field(word) for word in request.overrides}
    for field in sorted(given & variant.overrides.keys()):
        faults.add(f"--config.{field} is what the figure varies: leave it out", where)
    try:
        config = read_config(words)
    except command.UsageError as error:
        for sentence in str(error).split("\n  - ")[1:]:
            faults.add(sentence, where)
        return None, words
    is_short = request.preset == "paper" and choice.has_short_budget
    chosen = "total_frames" in given
    if is_short and not chosen and config.total_frames > figures.ABLATION_FRAMES:
        config.total_frames = figures.ABLATION_FRAMES
        words.append(f"--config.total_frames={config.total_frames}")
    return config, words


def _config_file(preset: str, method: str, task: str) -> str:
    """Returns FILE:ARGUMENT, seen from the current folder."""
    folder = os.path.relpath(ROOT / "configs")
    if preset == "tiny":
        return f"{folder}/tiny.py:{method},{task}"
    return f"{folder}/{method}.py:{task}"


def _seeds(request: Request, config: Config, words: list[str]) -> Iterator[Run]:
    # The settings decide on the name: --config.shift_padding=0 makes another variant.
    slug = figures.variant_of(config.to_dict()).slug
    for seed in range(max(request.num_seeds, 1)):
        folder = request.folder / config.task / slug / f"seed{seed}"
        yield Run(
            task=config.task,
            slug=slug,
            method=config.method,
            seed=seed,
            folder=folder,
            total_frames=config.total_frames,
            command=(
                *(sys.executable, "-m", "jaxil.launch"),
                *words,
                f"--config.seed={seed}",
                f"--workdir={folder}",
            ),
        )


def _check_folders(runs: list[Run], folder: pathlib.Path, faults: Faults) -> None:
    config = read_config(runs[0].command)
    for run in runs:
        config.seed = run.seed
        for sentence in workdir.problems(run.folder, config):
            # Without the folder's name, the same fault of many runs is one sentence.
            shown = sentence.replace(str(run.folder), f"{folder}/TASK/VARIANT/seedN")
            faults.add(shown, run.name)


def _field(word: str) -> str:
    return word.partition("=")[0].lstrip("-").removeprefix("config.")
