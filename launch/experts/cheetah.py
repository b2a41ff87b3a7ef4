r"""Records demonstrations of cheetah_run by a learned policy that thinks ahead.

    python -m jaxil.launch --config=configs/expert.py:cheetah_run --workdir=runs/cheetah
    python launch/experts/cheetah.py --workdir=runs/cheetah --output=cheetah_run.npz

Policies on state vectors stop near three quarters of the greatest speed for millions of
frames. So each decision starts from what the policy would do for ten more, tries 768
other sequences in the simulator, adds the critic's value of where each ends, and does
the best one's first action. One core needs some 40 seconds per episode.
"""

import pathlib
import sys
import time
from typing import Any

import numpy as np
import studio
from cheetah_search import Effort, Judge, Simulator, search

from jaxil.machine import startup

TASK = "cheetah_run"
EFFORT = Effort()


def record(folder: pathlib.Path, num_episodes: int, *, effort: Effort = EFFORT) -> Any:
    """Plays episodes and returns them as `StateDemonstrations`.

    Each episode's draws depend on its number alone. Progress goes to stderr.

    Args:
      folder: of a run on the task's state vectors; its newest checkpoint is taken.
      num_episodes: K.
      effort: of the search at each decision.

    Raises:
      UsageError: there is no such run.
    """
    judge, config, about = load_judge(folder)
    began_cpu = time.process_time()
    environment = studio.make_environment(TASK)
    simulator = Simulator(environment.physics)

    def begin(episode: int) -> studio.Decide:
        rng = np.random.default_rng([studio.SEED, episode])
        plan: np.ndarray | None = None

        def decide(step: int) -> np.ndarray:
            nonlocal plan
            del step
            plan = search(
                simulator,
                judge,
                simulator.now(),
                plan,
                effort,
                config.discount_factor,
                rng,
            )
            return plan[0]

        return decide

    arrays = studio.play(environment, begin, num_episodes)
    environment.close()
    return studio.demonstrations(
        TASK,
        arrays,
        f"{about}, improved by search with the simulator: at each decision "
        f"{effort.rounds} rounds of {effort.candidates} sequences of {effort.horizon} "
        "actions, judged by their rewards and the critic's value of their end; "
        f"{(time.process_time() - began_cpu) / 60:.0f} minutes of one core; no noise",
    )


def load_judge(folder: pathlib.Path) -> tuple[Judge, Any, str]:
    """Returns policy and values of a run, its config, and a few words on it.

    Raises:
      UsageError: there is no run of the task on state vectors, or no checkpoint.
    """
    import jax
    import jax.numpy as jnp

    from jaxil.errors import UsageError
    from jaxil.networks.agent import apply
    from jaxil.training import assembly, trained, workdir

    config = workdir.read_config(folder)
    for field, wanted in (("task", TASK), ("observation", "state")):
        if config[field] != wanted:
            raise UsageError(
                f"--workdir={folder} is a run with {field}={config[field]!r}, where "
                f"{wanted!r} is needed; name one of configs/expert.py:{TASK}"
            )
    run = trained.load(folder)
    encoder, actor, critic = run.params
    action_dim = run.environment.action_spec().shape[0]
    networks = assembly.make_networks(config, action_dim, mean=0.5)
    run.environment.close()

    @jax.jit
    def judge(observations: Any) -> tuple[jax.Array, jax.Array]:
        representation = apply(networks.encoder, encoder, observations)
        actions = jnp.tanh(apply(networks.actor, actor, representation))
        values = apply(networks.critic, critic, representation, actions)
        return actions, jnp.min(values, axis=0)

    return (
        lambda observations: jax.tree.map(np.asarray, judge(observations)),
        config,
        run.description(),
    )


def main(argv: list[str]) -> None:
    """Runs the command."""
    parser = studio.Parser(__doc__)
    parser.add_argument(
        "--workdir",
        type=pathlib.Path,
        required=True,
        help="folder of a run of configs/expert.py:cheetah_run",
    )
    values = parser.parse_args(argv)
    print(startup.prepare(), file=sys.stderr, flush=True)
    from jaxil.errors import UsageError

    try:
        studio.write(
            parser,
            values.output,
            lambda: record(values.workdir, values.num_episodes),
        )
    except UsageError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main(sys.argv[1:])
