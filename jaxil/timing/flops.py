"""How much arithmetic an update needs, counted by hand from the networks' sizes.

Matrix products and convolutions only, two operations (multiply, add) for each weight
that meets a number: what any program for the same update must do. XLA's own count
has activations, Adam and the random shift on top, about 2 % at the paper's sizes.

A layer costs m multiply-adds forward, m for the gradient of its weights and m for that
of its input, which the first layer above the data does without.
"""

from typing import NamedTuple


class Sizes(NamedTuple):
    """What the networks are made of.

    Attributes:
      encoder: multiply-adds of each layer for one observation.
      representation_dim: R.
      feature_dim: D.
      hidden_dim: width of the actor's and the critics' MLPs.
      action_dim: A.
    """

    encoder: tuple[int, ...]
    representation_dim: int
    feature_dim: int
    hidden_dim: int
    action_dim: int


class Discriminator(NamedTuple):
    """P-DAC's own network.

    Attributes:
      batch_size: N, expert samples and agent samples.
      hidden_dim: width.
      sees_actions: whether actions join the features.
    """

    batch_size: int
    hidden_dim: int
    sees_actions: bool


def pixel_encoder(
    image_size: int,
    input_channels: int,
    *,
    channels: tuple[int, ...],
    kernel_sizes: tuple[int, ...],
    strides: tuple[int, ...],
) -> tuple[tuple[int, ...], int]:
    """Counts the convolutions of one image; see `networks.encoder.PixelEncoder`.

    Args:
      image_size: H = W, large enough for all layers.
      input_channels: C, the stack folded in.
      channels: of each layer, as are the next two.
      kernel_sizes: sides.
      strides: of each layer.

    Returns:
      Multiply-adds of each layer, and R.
    """
    layers, side, depth = [], image_size, input_channels
    for features, kernel, stride in zip(channels, kernel_sizes, strides, strict=True):
        side = (side - kernel) // stride + 1
        layers.append(side * side * features * kernel * kernel * depth)
        depth = features
    return tuple(layers), side * side * depth


def drqv2_update(sizes: Sizes, batch_size: int) -> dict[str, int]:
    """Counts the learner's operations in one update, by part.

    The critic's part has the target, so the actor's and the target critic's pass over
    next observations; the actor's part has the critic's pass over its actions.

    Args:
      sizes: of the networks.
      batch_size: B.
    """
    trunk = sizes.representation_dim * sizes.feature_dim
    policy = sum(_mlp(sizes.feature_dim, sizes.hidden_dim, sizes.action_dim))
    values = 2 * sum(_mlp(sizes.feature_dim + sizes.action_dim, sizes.hidden_dim, 1))
    encoder = sum(sizes.encoder) + _trained(sizes.encoder)
    target = trunk + policy + trunk + values
    critic = target + 3 * (trunk + values)
    # No gradient leaves the actor's trunk, nor enters the critic's.
    actor = (2 * trunk + 3 * policy) + (trunk + 2 * values)
    parts = {"encoder": encoder, "critic": critic, "actor": actor}
    return {name: 2 * batch_size * count for name, count in parts.items()}


def adversarial_update(sizes: Sizes, discriminator: Discriminator) -> int:
    """Counts P-DAC's own operations in one update: experts' features, and its MLP.

    The gradient penalty passes the MLP four times: forward, back to the input, and
    both the weights' and the signal's share of the derivative of that.
    """
    width = sizes.feature_dim + discriminator.sees_actions * sizes.action_dim
    mlp = _mlp(width, discriminator.hidden_dim, 1)
    features = sum(sizes.encoder) + sizes.representation_dim * sizes.feature_dim
    per_sample = features + 2 * _trained(mlp) + 4 * sum(mlp)
    return 2 * discriminator.batch_size * per_sample


def cloning_update(sizes: Sizes, batch_size: int) -> dict[str, int]:
    """Counts the operations of one step of behavioural cloning, by part."""
    policy = sum(_mlp(sizes.feature_dim, sizes.hidden_dim, sizes.action_dim))
    trunk = sizes.representation_dim * sizes.feature_dim
    parts = {"encoder": _trained(sizes.encoder), "actor": 3 * (trunk + policy)}
    return {name: 2 * batch_size * count for name, count in parts.items()}


def matrix_product(size: int) -> int:
    """Counts the operations of a product of two square matrices."""
    return 2 * size**3


def _mlp(inputs: int, hidden: int, outputs: int) -> tuple[int, ...]:
    return inputs * hidden, hidden * hidden, hidden * outputs


def _trained(layers: tuple[int, ...]) -> int:
    """Forward, and the gradient of all weights, but none of the data."""
    return 3 * sum(layers) - layers[0]
