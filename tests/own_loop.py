"""An agent that is built and trained in a loop of one's own.

    python tests/own_loop.py

Everything is handed around explicitly: the state goes into `update_step` and comes out
of it, and what it learns from is sampled here.
"""

import numpy as np

from jaxil import presets
from jaxil.demonstrations import sampling
from jaxil.environments.evaluation import evaluate
from jaxil.machine import startup
from jaxil.training import agent as agents
from jaxil.training import assembly

NUM_EPISODES, NUM_UPDATES = 2, 3


def main() -> dict[str, float]:
    """Trains for a moment; returns the metrics of the last update."""
    startup.prepare()  # settings of jax and OpenGL, before either is used
    config = presets.get_config("tiny", "pdac,cartpole_swingup")
    config.update(action_repeat=20, image_size=24, hidden_dim=16, batch_size=8)
    config.encoder.update(channels=(32, 32), kernel_sizes=(4, 3), strides=(4, 1))
    config.discriminator.update(hidden_dim=16, batch_size=8)
    config.demonstrations.num_episodes = 1
    environment = assembly.training_environment(config)
    demonstrations = assembly.load_demonstrations(config)
    assert demonstrations is not None  # P-DAC imitates
    agent = agents.make_agent(config, environment, demonstrations)
    experts = agents.expert_episodes(agent.rewarder, demonstrations)
    replay = assembly.make_replay(config, environment)
    state, rng, metrics = agent.init_state(), np.random.default_rng(0), {}
    for number in range(NUM_EPISODES):
        (episode,) = evaluate(
            environment,
            lambda _: rng.uniform(-1.0, 1.0, environment.action_spec().shape),
            num_episodes=1,
            first_episode=number,
        ).episodes
        rewarder = agent.observe(state.rewarder, state.params, episode, experts)
        rewards = agent.rewards(rewarder, state.params, episode, experts)
        state = state.replace(rewarder=rewarder)
        replay.add_episode(**episode._replace(rewards=np.asarray(rewards))._asdict())
        for _ in range(NUM_UPDATES):
            batch = replay.sample(rng, config.batch_size)
            expert = sampling.sample(
                demonstrations,
                rng,
                agent.rewarder.expert_batch_size,
                frame_stack=config.frame_stack,
            )
            state, metrics = agent.update_step(state, batch, expert)
    return {name: float(value) for name, value in metrics.items()}


if __name__ == "__main__":
    print(main())
