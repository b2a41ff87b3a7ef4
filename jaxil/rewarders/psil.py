"""P-SIL: rewards from optimal transport to the closest demonstration."""

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder
from jaxil.networks.encoder import PixelEncoder
from jaxil.rewarders.coded import make_coded_rewarder
from jaxil.rewarders.matching import make_matching
from jaxil.rewarders.targets import make_target_rewarder

METHOD = methods.Method(
    name="psil",
    label="P-SIL",
    about="optimal transport to the closest demonstration",
    colour="#D55E00",
    rank=2,
    sections={"sinkhorn": methods.PSIL_SINKHORN},
    metrics=("sinkhorn/scale",),
    variations=(
        methods.Variation("sinkhorn.cost", "cosine", "{}"),
        methods.Variation("sinkhorn.alignment", "transport", "not aligned"),
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
) -> Rewarder:
    """Returns the rewarder of P-SIL.

        r_t = - scale * sum_n C_{t+1,n} P_{t+1,n}

    with cosine distances C and the Sinkhorn plan P to the demonstration that is
    cheapest to reach. It compares features of target copies of the encoder and the
    actor's trunk or, with `num_components`, principal components of the pixels; state
    vectors have none, so their features are compared. See `make_matching`,
    `make_target_rewarder` and `make_coded_rewarder` for the arguments.

    Source: Cohen et al. 2021, sec. 3.1, eqs. (1) to (5); epsilon, iterations and
    the copied trunk, which the paper leaves out, from siddhanthaldar/ROT.
    """
    matching = make_matching(
        cost=cost, alignment=alignment, epsilon=epsilon, num_iterations=num_iterations
    )
    if num_components and isinstance(agent.networks.encoder, PixelEncoder):
        return make_coded_rewarder(
            agent,
            num_components=num_components,
            compare=matching.rewards,
            plan=matching.closest_plan,
            return_scale=return_scale,
        )
    return make_target_rewarder(
        agent,
        compare=matching.rewards,
        plan=matching.closest_plan,
        target_update_steps=target_update_steps,
        return_scale=return_scale,
    )
