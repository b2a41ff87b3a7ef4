"""What a sweep is made of: each run's folder, settings and command."""

import dataclasses
import os
import pathlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from jaxil import command, methods, presets
from jaxil import config as jaxil_config
from jaxil.config import Config
from jaxil.errors import Fault, UsageError, unknown_name
from jaxil.reporting import figures
from jaxil.sweeps import state
from jaxil.sweeps.state import Run
from jaxil.training import workdir

PRESETS = ("paper", "tiny")
# What the sweep itself sets in each run.
_OWN_FLAGS = {"seed": "--seeds", "task": "--tasks", "method": "--methods"}
_SHOWN = 3  # runs that a fault lists
_MAX_SEEDS = 10_000


class Request(NamedTuple):
    """What the user asked for, unchecked."""

    methods: Sequence[str]
    ablations: Sequence[str]  # of `figures.studies`
    tasks: Sequence[str]
    num_seeds: int
    preset: str
    folder: pathlib.Path | None  # of the sweep; None if the user named none
    overrides: Mapping[str, str]  # of config fields, in all runs that have the field


class _Choice(NamedTuple):
    variant: figures.Variant
    has_short_budget: bool


def make_runs(
    request: Request, config_problems: Callable[[Config], Sequence[Fault]]
) -> list[Run]:
    """Returns all runs: seed 0 of everything first, so that early results compare.

    `config_problems` is `jaxil.training.assembly.problems`, whose import takes seconds.

    Raises:
      UsageError: names every fault of every run, each once.
    """
    # If no method is valid, one stands in, so that faults of tasks are found as well.
    choices = _choices(request) or [_Choice(figures.Variant("drqv2"), False)]
    groups = {f"{t}/{c.variant.slug}": (t, c) for t in request.tasks for c in choices}
    found = [(fault, "") for fault in _request_problems(request, choices)]
    planned: list[tuple[Config, list[Run]]] = []
    for where, (task, choice) in groups.items():
        try:
            config, words = _configured(request, task, choice)
        except UsageError as error:
            found += [(fault, where) for fault in error.faults]
        else:
            found += [(fault, where) for fault in config_problems(config)]
            planned.append((config, list(_seeds(request, config, words))))
    if not found and request.folder is not None:
        found = [
            (fault, run.name)
            for config, runs in planned
            for run in runs
            for fault in _folder_problems(request.folder, run, config)
        ]
    if found:
        raise UsageError(_each_once(found, everywhere=set(groups)))
    return [run for seed in zip(*(runs for _, runs in planned)) for run in seed]


def _request_problems(
    request: Request, choices: Sequence[_Choice]
) -> Iterator[Fault | str]:
    if not request.methods and not request.ablations:
        yield Fault("--methods", "is missing", "name some, such as --methods=pdac,psil")
    if request.preset not in PRESETS:
        yield unknown_name("--preset", request.preset, PRESETS)
    faulty = {m: faults for m in request.methods if (faults := _method_problems(m))}
    for faults in faulty.values():
        for fault in faults:
            yield dataclasses.replace(fault, subject="--methods")
    studies = figures.studies()
    for ablation in request.ablations:
        if ablation not in studies:
            yield unknown_name("--ablation", ablation, tuple(studies))
    if not request.tasks:
        yield Fault("--tasks", "is empty", "leave it out for the paper's eight")
    if not 1 <= request.num_seeds <= _MAX_SEEDS:
        rule = f"must lie in [1, {_MAX_SEEDS}]"
        yield Fault("--seeds", rule, value=request.num_seeds)
    folder = request.folder
    if folder is not None and os.path.exists(folder / "config.json"):
        rule, way_out = "is the folder of a single run", "name another for the sweep"
        yield Fault("--workdir", rule, way_out, str(folder))
    elif folder is not None:
        yield from workdir.problems(folder, jaxil_config.default_config())
    known = {
        field: None
        for choice in choices
        for field in jaxil_config.fields(choice.variant.method)
    }
    for field, value in request.overrides.items():
        if any(field in choice.variant.overrides for choice in choices):
            rule = "is what an ablation varies"
            yield Fault(f"--config.{field}", rule, "leave it out")
        elif field in _OWN_FLAGS:
            rule, way_out = "is what the sweep itself sets", f"use {_OWN_FLAGS[field]}"
            yield Fault(f"--config.{field}", rule, way_out, value)
        elif field not in known and not any(":" in name for name in faulty):
            yield unknown_name("field", field, tuple(known))


def _method_problems(method: str) -> tuple[Fault, ...]:
    try:
        declared = methods.get(method)
        if ":" in method:  # jaxil's own need no check
            methods.load(method, declared.make_rewarder)
    except UsageError as error:
        return tuple(fault for fault in error.faults if isinstance(fault, Fault))
    return ()


def _choices(request: Request) -> list[_Choice]:
    """Returns the union of what methods and ablations ask for, in their order."""
    known = [method for method in request.methods if not _method_problems(method)]
    named = [_Choice(figures.Variant(method), False) for method in known]
    studies = figures.studies()
    for study in (studies[a] for a in request.ablations if a in studies):
        named += [
            _Choice(variant, study.has_short_budget) for variant in study.variants
        ]
    union: dict[str, _Choice] = {}
    for choice in named:
        before = union.setdefault(choice.variant.slug, choice)
        # A run that serves two figures has the longer one's budget.
        short = before.has_short_budget and choice.has_short_budget
        union[choice.variant.slug] = _Choice(choice.variant, short)
    return list(union.values())


def _configured(
    request: Request, task: str, choice: _Choice
) -> tuple[Config, list[str]]:
    """Returns the config of a task's variant, or raises, and the words that make it."""
    method = choice.variant.method
    own = jaxil_config.fields(method).keys() - _OWN_FLAGS.keys()
    given = {name: v for name, v in request.overrides.items() if name in own}
    fields = {**given, **choice.variant.overrides}
    words = [
        *_preset(request.preset, method, task),
        *(f"--config.{name}={value}" for name, value in fields.items()),
    ]
    config = command.read_config(words)
    is_short = request.preset == "paper" and choice.has_short_budget
    frames = figures.ABLATION_FRAMES
    if is_short and "total_frames" not in given and config.total_frames > frames:
        config.total_frames = frames
        words.append(f"--config.total_frames={frames}")
    return config, words


def _preset(preset: str, method: str, task: str) -> list[str]:
    """Returns the words of a preset."""
    if preset == "tiny":
        return [f"--config=tiny:{method},{task}"]
    if method in presets.names():
        return [f"--config={method}:{task}"]
    return [f"--config=pdac:{task}", f"--config.method={method}"]  # from outside


def _seeds(request: Request, config: Config, words: list[str]) -> Iterator[Run]:
    # The settings name the variant: --config.shift_padding=0 makes another one.
    slug = figures.variant_of(config.to_dict()).slug
    sweep = request.folder or pathlib.Path()
    for seed in range(min(request.num_seeds, _MAX_SEEDS)):
        folder = sweep / config.task / slug / f"seed{seed}"
        own = (f"--config.seed={seed}", f"--workdir={folder}")
        yield Run(
            task=config.task,
            slug=slug,
            method=config.method,
            seed=seed,
            folder=folder,
            total_frames=config.total_frames,
            command=(sys.executable, "-m", "jaxil.launch", *words, *own),
        )


def _folder_problems(sweep: pathlib.Path, run: Run, config: Config) -> Iterator[Fault]:
    if state.damage(run):  # shown as such; the other runs go on
        return
    config.seed = run.seed
    for fault in workdir.problems(run.folder, config):
        # Under one name for all folders, a fault that many runs share is listed once.
        yield dataclasses.replace(fault, value=f"{sweep}/TASK/VARIANT/seedN")


def _each_once(
    found: Iterable[tuple[Fault | str, str]], everywhere: set[str]
) -> Iterator[Fault | str]:
    """Yields each fault once; one that some runs lack says which have it."""
    places: dict[Fault | str, list[str]] = {}
    for fault, where in found:
        places.setdefault(fault, []).append(where)
    for fault, where in places.items():
        if "" in where or {*where} >= everywhere:
            yield fault
        else:
            more = ", ..." if len(where) > _SHOWN else ""
            yield f"{fault} [{', '.join(where[:_SHOWN])}{more}]"
