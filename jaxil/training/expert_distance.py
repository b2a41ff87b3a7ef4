"""The paper's second measure: how far an agent's episodes are from the expert's."""

import json
import pathlib
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.environments.evaluation import evaluate
from jaxil.files.metrics import write_atomically
from jaxil.maths import transport
from jaxil.maths.types import Episode
from jaxil.networks.discriminator import Embedding
from jaxil.networks.encoder import PixelEncoder, StateEncoder
from jaxil.replay.stacking import gather_stacks
from jaxil.training import assembly
from jaxil.training.agent import stack_size

# The same for every method and run, so that their distances can be compared.
_ENCODER_SEED = 0
_RANDOM_POLICY_SEED = 2_000_029
_RANDOM_EPISODES = 5
_EPSILON, _NUM_ITERATIONS = 0.01, 100  # as P-SIL's; see `jaxil/config.py`
_FEATURE_DIM, _STATE_DIM = 50, 256
# Moments of an episode that are compared, evenly spaced: 500 of them would take
# longer than the episodes themselves, and change the ratio by a per cent.
_MOMENTS = 128
_MAX_DEMONSTRATIONS = 10
_LAYERS = ((3, 2), (3, 1), (3, 1), (3, 1))  # kernel and stride, as DrQ-v2's


class Closeness:
    """Measures the distance to the expert, relative to a random policy's.

        mean_{e,k} <C_ek, P_ek>   /   the same of uniformly random actions

    with cosine costs and Sinkhorn plans between the episodes e of an evaluation and
    the demonstrations k, all seen by one random encoder that is never trained. So 1
    is a random policy, and 0 is out of reach: starts differ from episode to episode.

    Source: Cohen et al. 2021, sec. 4.1 and fig. 4. Encoder, entropy and number of
    moments are not given there.
    """

    def __init__(
        self,
        config: Config,
        workdir: pathlib.Path,
        demonstrations: loading.Demonstrations,
    ) -> None:
        """Embeds the demonstrations; the random policy is played at the first use.

        Args:
          config: of the run.
          workdir: its folder, where the random policy's distance is kept.
          demonstrations: what the run imitates.
        """
        self._config = config
        self._path = workdir / "random_policy.json"
        frames = demonstrations.frames[:_MAX_DEMONSTRATIONS]
        self._embed = make_random_embedding(frames.shape[2:], stack_size(config))
        self._distance = jax.jit(mean_distance)
        self._experts = self._embed_all(
            [
                whole[:length]
                for whole, length in zip(
                    frames, demonstrations.num_frames, strict=False
                )
            ]
        )

    def relative_distance(self, episodes: list[Episode]) -> float:
        """Returns the distance of an evaluation's episodes; a random policy has 1."""
        return self._mean_distance(episodes) / self._of_random_policy()

    def _mean_distance(self, episodes: list[Episode]) -> float:
        agent = self._embed_all([episode.frames for episode in episodes])
        return float(self._distance(agent, self._experts))

    def _embed_all(self, episodes: list[np.ndarray]) -> Array:
        return jnp.stack([self._embed(frames) for frames in episodes])

    def _of_random_policy(self) -> float:
        try:
            return float(json.loads(self._path.read_text())["distance"])
        except FileNotFoundError:
            pass
        environment = assembly.environment_with_seed(self._config, _RANDOM_POLICY_SEED)
        rng = np.random.default_rng(_RANDOM_POLICY_SEED)
        shape = environment.action_spec().shape
        played = evaluate(
            environment,
            lambda _: rng.uniform(-1.0, 1.0, shape),
            num_episodes=_RANDOM_EPISODES,
            first_episode=0,
        )
        environment.close()
        distance = self._mean_distance(played.episodes)
        text = json.dumps(
            {"distance": distance, "task_return_mean": played.mean}, indent=2
        )
        write_atomically(self._path, f"{text}\n".encode())
        return distance


def make_random_embedding(frame_shape: tuple[int, ...], frame_stack: int) -> Any:
    """Returns frames of an episode, uint8 [T, H, W, 3] -> features [128, D].

    Args:
      frame_shape: (H, W, 3), or (S,) for state vectors. Small images get as many
        layers as they have pixels for.
      frame_stack: frames in an observation.
    """
    module = Embedding(_random_encoder(frame_shape), _FEATURE_DIM)
    stacked = (*frame_shape[:-1], frame_shape[-1] * frame_stack)
    params = module.init(jax.random.key(_ENCODER_SEED), jnp.zeros((1, *stacked)))
    apply = jax.jit(module.apply)

    def embed(frames: np.ndarray) -> Array:
        times = np.linspace(0, len(frames) - 1, _MOMENTS).round().astype(int)
        ages = np.arange(frame_stack - 1, -1, -1)
        indices = np.maximum(times[:, None] - ages, 0)
        return jnp.asarray(apply(params, gather_stacks(frames, indices)))

    return embed


def mean_distance(agent: Array, expert: Array) -> Array:
    """Returns the mean transport cost over all pairs of episodes.

    Args:
      agent: features of E episodes. Shape [E, T, D].
      expert: of K demonstrations. Shape [K, N, D].
    """

    def distance(mine: Array, theirs: Array) -> Array:
        cost = transport.cosine_cost(mine, theirs)
        mass = transport.uniform_mass(jnp.asarray(len(theirs)), len(theirs))
        plan = transport.sinkhorn_plan(
            cost, mass, epsilon=_EPSILON, num_iterations=_NUM_ITERATIONS
        )
        return jnp.sum(cost * plan)

    def to_all(mine: Array) -> Array:
        return jax.vmap(lambda theirs: distance(mine, theirs))(expert)

    return jnp.mean(jax.lax.map(to_all, agent))


def _random_encoder(frame_shape: tuple[int, ...]) -> nn.Module:
    if len(frame_shape) == 1:
        return StateEncoder(_STATE_DIM)
    layers, side = [], frame_shape[0]
    for kernel, stride in _LAYERS:
        side = (side - kernel) // stride + 1
        if side < 1:
            break
        layers.append((kernel, stride))
    kernels, strides = zip(*layers, strict=True)
    return PixelEncoder((32,) * len(layers), kernels, strides)
