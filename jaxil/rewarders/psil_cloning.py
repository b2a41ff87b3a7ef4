"""P-SIL whose actor also clones actions that inverse models infer for the video."""

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.rewarders import psil
from jaxil.rewarders.inferred_actions import with_cloning

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


def make_rewarder(
    agent: AgentSpec,
    *,
    cost: str,
    alignment: str,
    epsilon: float,
    num_iterations: int,
    target_update_steps: int,
    return_scale: float,
    num_components: int,
    num_pairs: int,
    weight: float,
    trust: str,
    trust_scale: float,
    num_models: int,
    head_dim: int,
    model_learning_rate: float,
) -> Rewarder:
    """Returns `psil.make_rewarder` with `with_cloning`; see there for the arguments."""
    inner = psil.make_rewarder(
        agent,
        cost=cost,
        alignment=alignment,
        epsilon=epsilon,
        num_iterations=num_iterations,
        target_update_steps=target_update_steps,
        return_scale=return_scale,
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
