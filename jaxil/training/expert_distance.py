"""The paper's second metric: the distance of an agent's episodes to the expert's."""

import json
import math
import pathlib
import zlib
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxil.config import Config
from jaxil.demonstrations import loading
from jaxil.environments.evaluation import evaluate
from jaxil.files.untrusted import read_regular
from jaxil.files.writing import write_atomically
from jaxil.maths.stacking import stack_times
from jaxil.maths.transport import sinkhorn_divergence
from jaxil.maths.types import Episode
from jaxil.networks.discriminator import Embedding
from jaxil.networks.encoder import PixelEncoder, StateEncoder
from jaxil.replay.stacking import gather_stacks
from jaxil.training import assembly
from jaxil.training.agent import stack_size
from jaxil.training.workdir import writes_to

# The same for every method and run, so that their distances can be compared.
_ENCODER_SEED = 0
_RANDOM_POLICY_SEED = 2_000_029
_RANDOM_EPISODES = 5
_EPSILON, _NUM_ITERATIONS = 0.01, 100  # as P-SIL's; see `jaxil/methods.py`
_FEATURE_DIM, _STATE_DIM = 50, 256
# Moments of an episode that are compared, evenly spaced, and episodes of one side:
# the cost matrix is [640, 640] at most.
_MOMENTS, MAX_EPISODES = 64, 10
_LAYERS = ((3, 2), (3, 1), (3, 1), (3, 1))  # kernel and stride, as DrQ-v2's
# Stored with a random policy's distance, which is measured again if this has changed.
_DEFINITION = "debiased Sinkhorn divergence of 64 moments an episode"


class ExpertDistance:
    """Measures the distance to the expert, relative to a random policy's.

        S(moments of an evaluation, moments of the demonstrations)
          / S(moments of uniformly random actions, moments of the demonstrations)

    with S the debiased Sinkhorn divergence between all moments of the episodes of
    either side, embedded by one random encoder that is never trained. So a random
    policy has distance 1 and the demonstrations themselves have 0; other episodes of
    the expert come close to 0, limited by their number and their starts.

    Source: Cohen et al. 2021, sec. 4.1 and fig. 4, which give neither encoder nor
    entropy nor number of moments. The debiasing is ours: without it, the distance of
    demonstrations to themselves is far from 0, because features of a random encoder
    differ by no more than the entropy blurs.
    """

    def __init__(
        self,
        config: Config,
        workdir: pathlib.Path,
        demonstrations: loading.Demonstrations,
    ) -> None:
        """Embeds the demonstrations.

        The first use plays the random policy, whose distance is stored in `workdir`.
        """
        self._config = config
        self._path = workdir / "random_policy.json"
        frames = demonstrations.frames
        self._embed = make_random_embedding(frames.shape[2:], stack_size(config))
        self._expert = self._embed_all(
            [whole[:n] for whole, n in zip(frames, demonstrations.num_frames)]
        )

    def relative_distance(
        self,
        episodes: list[Episode],
        *,
        stop_asked: Callable[[], bool] = lambda: False,
    ) -> float:
        """Returns the distance of an evaluation's first MAX_EPISODES episodes.

        Raises:
          Stopped: `stop_asked`, asked before each step of the random policy, said so.
          RunFolderError: the random policy's distance cannot be stored.
        """
        return self._distance(episodes) / self._of_random_policy(stop_asked)

    def _distance(self, episodes: list[Episode]) -> float:
        agent = self._embed_all([episode.frames for episode in episodes])
        return float(_divergence(agent, self._expert))

    def _embed_all(self, episodes: list[np.ndarray]) -> Array:
        return jnp.concatenate([self._embed(each) for each in episodes[:MAX_EPISODES]])

    def _of_random_policy(self, stop_asked: Callable[[], bool]) -> float:
        stored = _read(self._path)
        if stored is not None:
            return stored
        rng, seed = np.random.default_rng(_RANDOM_POLICY_SEED), _RANDOM_POLICY_SEED
        with assembly.environment_with_seed(self._config, seed) as environment:
            shape = environment.action_spec().shape
            played = evaluate(
                environment,
                lambda _: rng.uniform(-1.0, 1.0, shape),
                num_episodes=_RANDOM_EPISODES,
                first_episode=0,
                num_kept=_RANDOM_EPISODES,
                stop_asked=stop_asked,
            )
        # It may be zero where the expert acts at random too.
        distance = max(self._distance(played.episodes), 1e-12)
        content = {
            "distance": distance,
            "task_return_mean": played.mean,
            "definition": _DEFINITION,
        }
        content["checksum"] = _checksum(content)
        with writes_to(self._path.parent):
            write_atomically(self._path, json.dumps(content, indent=2).encode())
        return distance


def make_random_embedding(frame_shape: tuple[int, ...], frame_stack: int) -> Any:
    """Returns a function: frames of an episode [T, *frame_shape] -> features [64, 50].

    Frames are [H, W, 3], or [S] of state vectors. Small images get as many layers as
    they have pixels for.
    """
    module = Embedding(_random_encoder(frame_shape), _FEATURE_DIM)
    stacked = (*frame_shape[:-1], frame_shape[-1] * frame_stack)
    params = module.init(jax.random.key(_ENCODER_SEED), jnp.zeros((1, *stacked)))
    apply = jax.jit(module.apply)

    def embed(frames: np.ndarray) -> Array:
        times = np.linspace(0, len(frames) - 1, _MOMENTS).round().astype(int)
        indices = stack_times(times, frame_stack=frame_stack)
        return jnp.asarray(apply(params, gather_stacks(frames, indices)))

    return embed


@jax.jit
def _divergence(agent: Array, expert: Array) -> Array:
    return sinkhorn_divergence(
        agent, expert, epsilon=_EPSILON, num_iterations=_NUM_ITERATIONS
    )


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


def _read(path: pathlib.Path) -> float | None:
    """Returns a stored distance; None if it has to be computed again."""
    try:
        content = json.loads(read_regular(path))
        intact = content.pop("checksum") == _checksum(content)
        distance = float(content["distance"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    current = content.get("definition") == _DEFINITION
    valid = math.isfinite(distance) and distance > 0.0
    return distance if intact and current and valid else None


def _checksum(content: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(content, sort_keys=True).encode())
