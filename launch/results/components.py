r"""P-DAC whose discriminator judges principal components of the frames: an experiment.

    python launch/results/components.py walker_stand components.npz
    PYTHONPATH=launch/results COMPONENTS=components.npz jaxil train \
        --config=tiny:components:METHOD,walker_stand --workdir=runs/components

A method outside the package, as docs/own.md describes them. What it gave:
launch/results/README.md, "Learning: the ladder, rewards refreshed".
"""

import os
import sys

import jax.numpy as jnp
import numpy as np
import optax

from jaxil import methods
from jaxil.demonstrations import loading
from jaxil.environments import tasks
from jaxil.learner.rewarder import Rewarder
from jaxil.learner.state import init_module
from jaxil.maths import stacking
from jaxil.networks.agent import apply
from jaxil.networks.discriminator import Discriminator
from jaxil.rewarders.discrimination import scaled, update_discriminator

METHOD = methods.Method(
    name="components",
    label="P-DAC, components",
    about="adversarial rewards on principal components of the frames",
    colour="#AA4499",
    rank=20,
    sections={"discriminator": methods.DISCRIMINATOR},
    metrics=methods.DISCRIMINATOR_METRICS,
    needs_pixels=True,
)
_COMPONENTS, _MEAN_NORM = 32, 8.0
_EPISODES, _SAMPLES = 10, 1500  # of demonstrations, and of random play
_VIEW = {"action_repeat": 2, "image_size": 48, "render_quality": "fast"}


def make_rewarder(agent, *, hidden_dim, learning_rate, gradient_penalty, batch_size):
    """Returns P-DAC's rewarder with another view of an observation.

        r_t = logit D(x_{t+1}),    x = V^T (frames - mean)

    V is the same for each of the stacked frames and fixed before the run.
    """
    with np.load(os.environ["COMPONENTS"]) as file:
        basis, mean = jnp.asarray(file["basis"]), jnp.asarray(file["mean"])
    discriminator, optimiser = Discriminator(hidden_dim), optax.adam(learning_rate)
    width = agent.frame_stack * basis.shape[1]

    def see(observation):
        frames = jnp.split(scaled(observation), agent.frame_stack, axis=-1)
        codes = [(x.reshape(len(x), -1) - mean[None]) @ basis for x in frames]
        return jnp.concatenate(codes, axis=-1) / np.sqrt(agent.frame_stack)

    def logits(params, x):
        return apply(discriminator, params, x)

    def init(key, spec, learner):
        del spec, learner
        return init_module(discriminator.init(key, jnp.zeros((1, width))), optimiser)

    def update(state, learner, view, expert, key):
        del learner
        return update_discriminator(
            state,
            logits,
            see(expert.observation),
            see(view.unshifted[:batch_size]),
            key,
            penalty_weight=gradient_penalty,
            optimiser=optimiser,
        )

    def rewards(state, learner, episode, expert_episodes):
        del learner, expert_episodes
        stacked = stacking.stack_frames(episode.frames, frame_stack=agent.frame_stack)
        return logits(state.params, see(stacked[1:]))

    return Rewarder(
        rewards,
        init,
        update,
        expert_batch_size=batch_size,
        rewards_changed=lambda state: True,
    )


def main(task: str, output: str) -> None:
    """Writes the components of demonstrations and random play, and the mean frame."""
    expert = loading.load("", task=task, num_episodes=_EPISODES, **_VIEW).frames
    frames = np.concatenate(
        [_sample(expert, _SAMPLES), _sample(_random_play(task), _SAMPLES)]
    )
    mean = _flat(expert.reshape(-1, *expert.shape[2:])).mean(0)
    centred = frames - mean
    variances, vectors = np.linalg.eigh(centred @ centred.T / len(centred))
    variances, vectors = variances[-_COMPONENTS:], vectors[:, -_COMPONENTS:]
    basis = centred.T @ vectors / np.sqrt(variances * len(centred))
    norm = np.linalg.norm(centred @ basis, axis=1).mean()
    np.savez(output, allow_pickle=False, basis=basis * _MEAN_NORM / norm, mean=mean)


def _flat(frames):
    return frames.reshape(len(frames), -1).astype(np.float32) / 255.0


def _sample(frames, count):
    frames = frames.reshape(-1, *frames.shape[2:])
    return _flat(frames[np.random.default_rng(0).integers(0, len(frames), count)])


def _random_play(task):
    """Returns the frames of random actions, each held for a random time."""
    environment = tasks.make_environment(task, seed=77, frame_stack=1, **_VIEW)
    rng, episodes = np.random.default_rng(0), []
    shape = environment.action_spec().shape
    for episode in range(_EPISODES):
        frames = [environment.reset(episode=episode).observation]
        hold, action = rng.integers(1, 10), np.zeros(shape)
        for step in range(environment.episode_steps):
            if step % hold == 0:
                action = rng.uniform(-1.0, 1.0, shape)
            frames.append(environment.step(action).observation)
        episodes.append(frames)
    return np.asarray(episodes)


if __name__ == "__main__":
    main(*sys.argv[1:])
