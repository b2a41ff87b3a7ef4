"""P-DAC whose actor also clones actions that inverse models infer for the video."""

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.rewarders import pdac
from jaxil.rewarders.inferred_actions import with_cloning

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


def make_rewarder(
    agent: AgentSpec,
    *,
    hidden_dim: int,
    learning_rate: float,
    gradient_penalty: float,
    batch_size: int,
    sees_actions: bool,
    num_components: int,
    num_pairs: int,
    weight: float,
    trust: str,
    trust_scale: float,
    num_models: int,
    head_dim: int,
    model_learning_rate: float,
) -> Rewarder:
    """Returns `pdac.make_rewarder` with `with_cloning`; see there for the arguments."""
    inner = pdac.make_rewarder(
        agent,
        hidden_dim=hidden_dim,
        learning_rate=learning_rate,
        gradient_penalty=gradient_penalty,
        batch_size=batch_size,
        sees_actions=sees_actions,
        num_components=num_components,
    )
    return with_cloning(
        inner,
        agent,
        num_pairs=num_pairs,
        weight=weight,
        trust=trust,
        trust_scale=trust_scale,
        num_models=num_models,
        head_dim=head_dim,
        model_learning_rate=model_learning_rate,
    )
