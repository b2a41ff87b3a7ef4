r"""Records demonstrations of cheetah_run by a learned policy with planning.

    python -m jaxil.launch --config=configs/expert.py:cheetah_run --workdir=runs/cheetah
    python launch/experts/cheetah.py --workdir=runs/cheetah --output=cheetah_run.npz

Policies on state vectors stay near three quarters of full speed for millions of frames.
So each decision varies the policy's next ten actions, simulates 768 sequences, adds the
critic's value of each final state, and takes the first action of the best sequence. An
episode takes about 40 seconds of one core.
"""

import pathlib
from typing import Any

import numpy as np
import studio
from cheetah_search import Effort, Judge, Planner, Simulator

TASK = "cheetah_run"


def record(
    folder: pathlib.Path, num_episodes: int, effort: Effort | None = None
) -> Any:
    """Returns `StateDemonstrations` of a run on state vectors, improved by search."""
    effort = effort or Effort()
    judge, discount, about = _load_judge(folder)

    def prepare(environment: Any) -> Any:
        simulator = Simulator(environment.physics)
        planner = Planner(simulator, judge, discount, effort)

        def begin(episode: int) -> Any:
            rng = np.random.default_rng([studio.SEED, episode])
            plan: np.ndarray | None = None

            def decide(step: int, observation: np.ndarray) -> np.ndarray:
                nonlocal plan
                del step, observation
                plan = planner.search(simulator.now(), plan, rng)
                return plan[0]

            return decide

        return begin

    return studio.record(
        TASK,
        prepare,
        num_episodes,
        f"{about}, improved by search with the simulator: at each decision "
        f"{effort.rounds} rounds of {effort.candidates} sequences of {effort.horizon} "
        "actions, judged by their rewards and the critic's value of their end",
    )


def _load_judge(folder: pathlib.Path) -> tuple[Judge, float, str]:
    """Returns a run's policy and values, its discount factor and its description."""
    import jax
    import jax.numpy as jnp

    from jaxil.command import UsageError
    from jaxil.networks.agent import apply
    from jaxil.training import trained

    policy = trained.load_policy(folder)
    config = policy.config
    for field, wanted in (("task", TASK), ("observation", "state")):
        if config[field] != wanted:
            raise UsageError(
                f"--workdir={folder} is a run with {field}={config[field]!r}, not "
                f"{wanted!r}; name a run of configs/expert.py:{TASK}"
            )
    networks, (encoder, actor, critic) = policy.networks, policy.params

    @jax.jit
    def judge(observations: Any) -> tuple[jax.Array, jax.Array]:
        representation = apply(networks.encoder, encoder, observations)
        actions = jnp.tanh(apply(networks.actor, actor, representation))
        values = apply(networks.critic, critic, representation, actions)
        return actions, jnp.min(values, axis=0)

    return (
        lambda observations: jax.tree.map(np.asarray, judge(observations)),
        config.discount_factor,
        policy.description(),
    )


if __name__ == "__main__":
    parser = studio.Parser(__doc__)
    parser.add_argument(
        "--workdir",
        type=pathlib.Path,
        required=True,
        help="folder of a run of configs/expert.py:cheetah_run",
    )
    studio.run(parser, lambda values: record(values.workdir, values.num_episodes))
