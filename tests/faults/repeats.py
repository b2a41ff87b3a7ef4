"""One update and the rewards of one episode, computed again and again and hashed.

    python -m tests.faults.repeats --methods=pdac,psil --repeats=200

Floating-point results that vary between repeats of one compiled program would break the
promise that a resumed run repeats an unbroken one. Each kind of convolutions and number
of cores is a process of its own, with all methods one after the other.
"""

import argparse
import hashlib
import importlib.metadata
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

METHODS = (
    "pdac,psil,temporal_ot,orca,patchail,laifo,gaifo,dac,sil,bc,bco,bcvlr,"
    "pdac_cloning,psil_cloning,drqv2,zero"
)
# Large enough for XLA to divide the work of an update among cores.
SIDE, BATCH, HIDDEN = 20, 16, 256


def measure(methods: Sequence[str], repeats: int) -> Iterator[dict[str, Any]]:
    """Yields a row for each kind of convolutions, number of cores and method."""
    for convolutions in ("native", "xla"):
        for cores in ("1", "2"):
            work = [convolutions, cores, str(repeats), *methods]
            with subprocess.Popen(
                [sys.executable, "-m", "tests.faults.repeats", "--work", *work],
                stdout=subprocess.PIPE,
                text=True,
            ) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    yield json.loads(line)
            if process.returncode:
                raise RuntimeError(f"{' '.join(work)}: status {process.returncode}")


def _work(convolutions: str, cores: int, repeats: int, methods: list[str]) -> None:
    """Prints the rows of one process."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is rendered
    from jaxil.machine import startup

    startup.prepare()

    from tests.training import drawing as runs

    runs.SIDE = SIDE
    for method in methods:
        compute = _computation(method, convolutions)
        digests = {compute() for _ in range(repeats)}
        row = {
            "jaxlib": importlib.metadata.version("jaxlib"),
            "method": method,
            "convolutions": convolutions,
            "cores": cores,
            "repeats": repeats,
            "different": len(digests),
            "digest": min(digests)[:8],
        }
        print(json.dumps(row), flush=True)


def _computation(method: str, convolutions: str) -> Any:
    """Returns a function that updates a copy of one state and hashes what comes out."""
    import jax
    import numpy as np

    from jaxil.training import agent as agents
    from jaxil.training import assembly
    from jaxil.training.updates import Updates
    from tests.training import drawing as runs

    config = runs.make_config(method, hidden_dim=HIDDEN, batch_size=BATCH)
    config.encoder.channels = (32, 32)
    config.encoder.convolutions = convolutions
    native = agents.uses_native_convolutions(config)
    assert native == (convolutions == "native"), "the encoder in C cannot be had here"
    environment: Any = runs.Drawing()
    demonstrations = runs.make_demonstrations()
    agent = agents.make_agent(config, environment, demonstrations)
    replay = assembly.make_replay(config, environment)
    rng = np.random.default_rng(0)
    for frames in demonstrations.frames:
        replay.add_episode(
            frames=frames,
            actions=rng.uniform(-1, 1, (runs.STEPS, 2)).astype(np.float32),
            rewards=rng.normal(size=runs.STEPS),
            discounts=np.ones(runs.STEPS),
        )
    experts = agents.expert_episodes(agent.rewarder, demonstrations)
    updates = Updates(config, agent, replay, demonstrations, experts)
    state = agent.init_state()
    for _ in range(3):  # so that no moment of Adam is zero
        state, _ = agent.update_step(state, *updates.sample(rng), None)
    batch, stored = updates.sample(rng), replay.episode(0)
    # Backwards, so that it is no demonstration: its transport would cost nothing.
    episode = stored._replace(frames=stored.frames[::-1].copy())
    rewarder = agent.observe(state.rewarder, state.params, episode, experts)
    state = state.replace(rewarder=rewarder)
    rewards = agent.rewards(rewarder, state.params, episode, experts)
    assert np.isfinite(rewards).all()

    def compute() -> str:
        fresh = jax.tree.map(jax.numpy.copy, state)
        rewards = agent.rewards(fresh.rewarder, fresh.params, episode, experts)
        after = agent.update_step(fresh, *batch, None)
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves((rewards, after)):
            if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                leaf = jax.random.key_data(leaf)
            digest.update(np.asarray(leaf).tobytes())
        return digest.hexdigest()

    return compute


def main() -> int:
    """Prints a row for each, and fails if any result differs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--work", nargs="+", help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.work:
        convolutions, cores, repeats, *methods = flags.work
        _work(convolutions, int(cores), int(repeats), methods)
        return 0
    held = True
    for row in measure(flags.methods.split(","), flags.repeats):
        print(json.dumps(row), flush=True)
        held &= row["different"] == 1
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
