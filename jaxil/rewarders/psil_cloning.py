"""P-SIL whose actor also clones actions that inverse models infer for the video."""

from typing import Any

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.rewarders import psil
from jaxil.rewarders.pseudo_actions import make_cloning_rewarder

METHOD = methods.Method(
    name="psil_cloning",
    label="P-SIL+C",
    about="P-SIL's rewards, and actions inferred from the video",
    colour="#994455",
    rank=16,
    sections={
        "sinkhorn": methods.PSIL_SINKHORN,
        "cloning": methods.PSEUDO_ACTIONS,
        "inverse_model": methods.INVERSE_MODELS,
    },
    metrics=("sinkhorn/scale", *methods.INVERSE_MODELS_METRICS),
    variations=(
        methods.Variation("sinkhorn.cost", "cosine", "{}"),
        methods.Variation("sinkhorn.alignment", "transport", "not aligned"),
        methods.Variation("cloning.trust", "agreement", "trust {}"),
    ),
)


def make_rewarder(agent: AgentSpec, **settings: Any) -> Rewarder:
    """Returns `psil.make_rewarder` with `with_cloning`; see there for the settings."""
    return make_cloning_rewarder(psil.make_rewarder, agent, settings)
