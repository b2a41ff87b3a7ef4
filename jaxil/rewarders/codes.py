"""A code of frames that needs no training: their principal components."""

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from jaxil.maths import components, stacking
from jaxil.maths.types import AnyEpisode, ExpertEpisodes
from jaxil.rewarders.discrimination import scaled

# The four episodes that usually come before the first update weigh as much together
# as all demonstrations.
_DEMONSTRATION_ROWS, _EPISODE_ROWS = 1024, 256
_NORM = 8.0  # of an observation's code, root mean square: penalties depend on it
_SMALLEST_SCALE = 1e-3  # anything smaller is rounding, which must not be magnified


class FrameCode(struct.PyTreeNode):
    """Principal components of demonstrations and of the agent's first episodes.

    Each episode refines it until `is_fixed`: rewards need features that keep their
    meaning. The agent's episodes add poses that no demonstration has.

    Attributes:
      mean: of demonstrations' frames, in [0, 1]. Shape [P], with P = H W 3.
      sketch: see `components.merge`. Shape [J, P].
      num_rows: frames that it was fitted on. Shape [].
      is_fixed: set by P-DAC's first update, by P-SIL's first episode. Shape [], bool.
    """

    mean: Array
    sketch: Array
    num_rows: Array
    is_fixed: Array


def init_code(
    observation_shape: tuple[int, ...], *, num_components: int, frame_stack: int
) -> FrameCode:
    """Returns a code that has seen nothing, for observations [H, W, F * 3]."""
    height, width, channels = observation_shape
    size = height * width * channels // frame_stack
    return FrameCode(
        mean=jnp.zeros(size),
        sketch=jnp.zeros((num_components, size)),
        num_rows=jnp.zeros(()),
        is_fixed=jnp.zeros((), bool),
    )


def observe(code: FrameCode, episode: AnyEpisode, experts: ExpertEpisodes) -> FrameCode:
    """Returns the code fitted to one more episode, unless it is fixed."""
    return jax.lax.cond(
        code.is_fixed, lambda: code, lambda: fit(code, episode, experts)
    )


def fit(code: FrameCode, episode: AnyEpisode, experts: ExpertEpisodes) -> FrameCode:
    """Returns the code fitted to one more episode; a new one also to demonstrations."""
    code = jax.lax.cond(
        code.num_rows == 0.0, lambda: _begin(code, experts), lambda: code
    )
    return _merge(code, *_sample_episode(episode))


def fix(code: FrameCode) -> FrameCode:
    """Returns the code, which `observe` leaves as it is from now on."""
    return code.replace(is_fixed=jnp.ones((), bool))


def encode_frames(code: FrameCode, frames: Array) -> Array:
    """Returns the codes of frames: [M, H, W, 3] to [M, J].

    NaN before the first episode, so that a loop that forgets `observe` fails at once.
    """
    scale = jnp.sqrt(jnp.sum(code.sketch**2) / code.num_rows)
    codes = components.project(_rows(frames) - code.mean[None], code.sketch)
    return codes * (_NORM / jnp.maximum(scale, _SMALLEST_SCALE))


def encode(code: FrameCode, observation: Array, *, frame_stack: int) -> Array:
    """Returns the codes of observations: [B, H, W, F * 3] to [B, F * J]."""
    chex.assert_rank(observation, 4)
    *size, channels = observation.shape
    frames = observation.reshape(*size, frame_stack, channels // frame_stack)
    frames = jnp.moveaxis(frames, 3, 1).reshape(-1, *size[1:], channels // frame_stack)
    codes = encode_frames(code, frames).reshape(len(observation), -1)
    return codes / jnp.sqrt(frame_stack)


def encode_episode(code: FrameCode, frames: Array, *, frame_stack: int) -> Array:
    """Returns `encode` of all observations of an episode, each frame encoded once.

    Maps frames [T + 1, H, W, 3] to [T + 1, F * J].
    """
    codes = encode_frames(code, frames)
    codes = stacking.stack_frames(codes, frame_stack=frame_stack)
    return codes / jnp.sqrt(frame_stack)


def _begin(code: FrameCode, experts: ExpertEpisodes) -> FrameCode:
    rows = _sample_demonstrations(experts)
    code = code.replace(mean=jnp.mean(rows, axis=0))
    return _merge(code, rows, jnp.ones(len(rows)))


def _merge(code: FrameCode, rows: Array, weights: Array) -> FrameCode:
    """Returns the code fitted to rows [M, P] too, which count 1 or 0 times, [M]."""
    weighted = weights[:, None] * (rows - code.mean[None])
    return code.replace(
        sketch=components.merge(code.sketch, weighted),
        num_rows=code.num_rows + jnp.sum(weights),
    )


def _sample_demonstrations(experts: ExpertEpisodes) -> Array:
    """Returns frames evenly spaced over all demonstrations. Shape [M, P]."""
    numbers = jnp.arange(_DEMONSTRATION_ROWS)
    which = numbers % len(experts.num_frames)
    share = numbers / _DEMONSTRATION_ROWS  # of the way through its demonstration
    moment = jnp.floor(share * jnp.asarray(experts.num_frames)[which])
    return _rows(jnp.asarray(experts.frames)[which, moment.astype(jnp.int32)])


def _sample_episode(episode: AnyEpisode) -> tuple[Array, Array]:
    """Returns frames evenly spaced over an episode, [M, P], and their weights, [M].

    A short episode has each frame once; rows of its padding weigh 0.
    """
    frames, num_steps = jnp.asarray(episode.frames), episode.num_steps
    num_rows = min(_EPISODE_ROWS, len(frames))
    last = jnp.maximum(num_steps, num_rows - 1)
    moments = jnp.arange(num_rows) * last // max(num_rows - 1, 1)
    return _rows(frames[moments]), (moments <= num_steps).astype(jnp.float32)


def _rows(frames: Array) -> Array:
    return scaled(frames).reshape(len(frames), -1)
