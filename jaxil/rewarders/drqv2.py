"""DrQ-v2: the task's own reward; no imitation."""

from jax import Array

from jaxil import methods
from jaxil.learner.rewarder import AgentSpec, Rewarder, RewarderState
from jaxil.learner.state import LearnerParams
from jaxil.maths.types import AnyEpisode, ExpertEpisodes

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

    def rewards(
        state: RewarderState,
        learner: LearnerParams,
        episode: AnyEpisode,
        expert_episodes: ExpertEpisodes | None,
    ) -> Array:
        del state, learner, expert_episodes
        return episode.rewards

    return Rewarder(rewards, ignores_padding=True)
