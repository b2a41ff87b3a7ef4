"""Imitation methods as declarations that can be read without importing jax.

A method is one file: its rewarder, and beside it `METHOD = methods.Method(...)`.
Configs name those of `jaxil/rewarders`, and those of installed packages with an entry
point in the group `jaxil.methods`, by the method's name; any other by
`--config.method=package.module:METHOD`.

A declaration is evaluated without the rest of its file, so that the report, sweeps and
`--help` start without jax: it may use literals and this module, under the name
`methods`. If it uses anything else, its file is imported.
"""

import ast
import contextlib
import functools
import importlib
import importlib.metadata
import importlib.util
import pathlib
import sys
from typing import Any

from jaxil import declarations, outside
from jaxil.declarations import Field, Method
from jaxil.declarations import Variation as Variation  # METHODs use it from here
from jaxil.errors import Fault, UsageError, raised, unknown_name

_FOLDER = pathlib.Path(__file__).parent / "rewarders"
_ENTRY_POINTS = "jaxil.methods"

DISCRIMINATOR = {
    "hidden_dim": Field(1024, "width of its hidden layers; 1024 in ROT", 1, 10**5),
    "learning_rate": Field(1e-4, "of its Adam; 1e-4 in ROT", 0, 1, positive=True),
    "gradient_penalty": Field(10.0, "its weight; 10 in the paper", 0, 1e6),
    "batch_size": Field(
        128,
        "expert samples, and samples of the agent's batch, in an update; 128 in ROT",
        1,
        65_536,
        at_most="batch_size",
    ),
}
COMPONENTS = Field(
    0,
    "principal components of each frame to use; 0: features, as in the paper",
    0,
    1024,
)
PDAC_DISCRIMINATOR = {
    **DISCRIMINATOR,
    "sees_actions": Field(False, "appends actions to the features"),
    "num_components": COMPONENTS,
}
CLONING = {
    "batch_size": Field(128, "expert samples; 128 in ROT", 1, 65_536),
    "std": Field(
        0.1, "std of the policy in the likelihood loss; 0.1 in ROT", 1e-6, 10.0
    ),
}
# Beside these stand another method's sections. All fields are keyword arguments of one
# function, so no name may occur twice.
PSEUDO_ACTIONS = {
    "num_pairs": Field(128, "expert transitions that are cloned", 1, 65_536),
    "weight": Field(
        0.4, "of the cloning term, in units of mean |Q|; 1 / 2.5 in TD3+BC", 0, 1e6
    ),
    "trust": Field(
        "agreement",
        "what weights a label: its models' agreement; the critic's preference; nothing",
        choices=("agreement", "q_filter", "none"),
    ),
    "trust_scale": Field(
        0.01, "variance of labels at which agreement is 1/e", 0, 1e6, positive=True
    ),
}
INVERSE_MODELS = {
    "num_models": Field(3, "heads on one encoder; 1 always agrees", 1, 100),
    "head_dim": Field(1024, "width of their hidden layers", 1, 10**5),
    "model_learning_rate": Field(1e-4, "of their Adam", 0, 1, positive=True),
}
INVERSE_MODELS_METRICS = ("inverse_model/error", "inverse_model/agreement")
DISCRIMINATOR_METRICS = (
    "discriminator/loss",
    "discriminator/penalty",
    "discriminator/expert_logit",
    "discriminator/agent_logit",
)
RELABELS = Field(
    True,
    "rewards are recomputed for every batch; False: stored, see reward_refresh_steps",
)
SINKHORN = {
    "cost": Field("cosine", "between features", choices=("cosine", "euclidean")),
    "alignment": Field(
        "transport",
        "how time steps are paired; time: step t with step t",
        choices=("transport", "time"),
    ),
    "epsilon": Field(
        0.01, "weight of the entropy, in units of cost; 0.01 in ROT", 1e-4, 1e3
    ),
    "num_iterations": Field(100, "Sinkhorn iterations; 100 in ROT", 1, 10**6),
    "return_scale": Field(
        10.0, "the first episode returns minus this; 10 in the paper", 1e-6, 1e6
    ),
}
TARGETS = {
    "target_update_steps": Field(
        10_000, "agent steps between two target copies; 10000 in the paper", 1, 10**9
    ),
}
PSIL_SINKHORN = {**SINKHORN, **TARGETS, "num_components": COMPONENTS}


def known() -> dict[str, Method]:
    """Returns the methods that configs may name, by name, in the order of tables.

    Installed ones that cannot be loaded are left out, each named once on stderr.
    """
    found = {}
    for name, reference in _references().items():
        try:
            found[name] = _declaration(reference)
        except UsageError as error:
            _say_once(f"the installed method {name!r} is left out: {error}")
    return dict(sorted(found.items(), key=lambda item: (item[1].rank, item[0])))


def get(name: str) -> Method:
    """Returns a method; imports its module if its declaration needs that.

    A name is a key of `known()`, or "package.module:METHOD". If it comes from a file
    and not from the user, see `is_trusted` first.

    Raises:
      UsageError: there is no such method.
    """
    reference = _references().get(name)
    outside.trust(name)
    if reference is None and ":" not in name:
        choices = (*known(), "package.module:METHOD")
        raise UsageError(unknown_name("method", name, choices))
    return _declaration(reference or name)._replace(name=name)


def is_trusted(name: str) -> bool:
    """Returns whether a file may name this method.

    It must be installed, or named by the user in this process: see `outside`.
    """
    return name in _references() or outside.is_trusted(name)


def load(name: str, function: str) -> Any:
    """Imports a method's file and returns one of its functions.

    Raises:
      UsageError: the file cannot be imported, or has no such function.
    """
    path = _references().get(name, name).partition(":")[0]
    try:
        module = importlib.import_module(path)
    except (Exception, SystemExit) as error:  # whatever the user's file raises
        rule = f"cannot be loaded: {raised(error)}"
        raise UsageError(Fault("method", rule, value=name)) from error
    if not hasattr(module, function):
        rule = f"is declared without its function: {path!r} has no `{function}`"
        raise UsageError(Fault("method", rule, value=name))
    return getattr(module, function)


@functools.cache
def _references() -> dict[str, str]:
    files = sorted(p for p in _FOLDER.glob("*.py") if _assignment(p, "METHOD"))
    own = {p.stem: f"jaxil.rewarders.{p.stem}:METHOD" for p in files}
    try:
        points = importlib.metadata.entry_points(group=_ENTRY_POINTS)
        return {**{point.name: point.value for point in points}, **own}
    except Exception as error:  # a package's list that is damaged
        _say_once(f"installed methods are left out, their list is damaged: {error!r}")
        return own


@functools.cache
def _say_once(text: str) -> None:
    print(text, file=sys.stderr)


@functools.cache
def _declaration(reference: str) -> Method:
    module, _, name = reference.partition(":")
    spec = outside.spec_of(module)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        rule = f"names no module {module!r} that Python finds"
        way_out = "install its package, or add its folder to PYTHONPATH"
        raise UsageError(Fault("method", rule, way_out, reference))
    method: Any = None
    try:
        expression = _assignment(pathlib.Path(spec.origin), name or "METHOD")
        if expression is not None:
            code = compile(ast.Expression(expression), spec.origin, "eval")
            with contextlib.suppress(NameError):  # it uses names of its own file
                method = eval(code, {"methods": sys.modules[__name__]})
        if method is None:
            method = getattr(importlib.import_module(module), name or "METHOD", None)
    except (Exception, SystemExit) as error:  # whatever is wrong with the file
        rule = f"cannot be loaded: {raised(error)}"
        raise UsageError(Fault("method", rule, value=reference)) from error
    if isinstance(method, Method):
        rules = [*declarations.problems(method)]
    else:
        rules = [f"is not declared: {module!r} has no `{name} = methods.Method(...)`"]
    if rules:
        raise UsageError([Fault("method", rule, value=reference) for rule in rules])
    return method


@functools.cache
def _assignment(path: pathlib.Path, name: str) -> ast.expr | None:
    """Returns the value that a file's top level assigns to a name."""
    for node in ast.parse(path.read_text(), str(path)).body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == name
            for target in node.targets
        ):
            return node.value
    return None
