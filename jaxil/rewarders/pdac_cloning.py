"""P-DAC whose actor also clones actions that inverse models infer for the video."""

from jaxil import methods
from jaxil.rewarders import pdac
from jaxil.rewarders.inferred_actions import add_cloning

METHOD = methods.Method(
    name="pdac_cloning",
    label="P-DAC+C",
    about="P-DAC's rewards, and actions inferred from the video",
    colour="#6699CC",
    rank=15,
    sections={
        "discriminator": methods.PDAC_DISCRIMINATOR,
        "cloning": methods.PSEUDO_ACTIONS,
        "inverse_model": methods.INVERSE_MODELS,
    },
    sees_actions="discriminator.sees_actions",
    metrics=(*methods.DISCRIMINATOR_METRICS, *methods.INVERSE_MODELS_METRICS),
    variations=(
        methods.Variation("discriminator.sees_actions", False, "actions"),
        methods.Variation("cloning.trust", "agreement", "trust {}"),
    ),
)

make_rewarder = add_cloning(pdac.make_rewarder)
