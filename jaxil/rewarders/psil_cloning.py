"""P-SIL whose actor also clones actions that inverse models infer for the video."""

from jaxil import methods
from jaxil.rewarders import psil
from jaxil.rewarders.inferred_actions import add_cloning

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

make_rewarder = add_cloning(psil.make_rewarder)
