"""DrQ-v2: the task's own reward; no imitation."""

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder

METHOD = methods.Method(
    name="drqv2",
    label="DrQ-v2",
    about="the task's own reward",
    colour="#CC79A7",
    rank=6,
    uses_demonstrations=False,
)


def make_rewarder(agent: AgentSpec) -> Rewarder:
    """Returns a rewarder of the environment's own rewards."""
    del agent
    return Rewarder(
        lambda state, learner, episode, experts: episode.rewards, ignores_padding=True
    )
