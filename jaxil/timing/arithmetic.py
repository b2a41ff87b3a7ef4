"""Operations of the update, counted twice; memory of its program; how busy it is."""

from typing import Any

from jaxil.config import Config
from jaxil.timing import device, flops
from jaxil.timing.bench import Bench


def count(bench: Bench, update_ms: float) -> dict[str, Any]:
    """Returns what XLA and `flops` say about the update.

    The utilisation divides the operations counted by hand, where there are any, by
    time and by the rate of this device's own matrix products: XLA's count of a program
    can miss what it hands to other libraries, and has work that is no product.

    Args:
      bench: whose update is compiled once more, from the cache as a rule, and once
        with XLA's convolutions.
      update_ms: measured.

    Returns:
      Operations in GFLOP, memory in MB; None where XLA or `flops` can't tell.
    """
    plain = bench.lower_plain_update().compile()
    by_xla = (plain.cost_analysis() or {}).get("flops")
    by_hand = by_part(
        bench.run.config, bench.episode.frames.shape[1:], bench.episode.actions.shape[1]
    )
    total = None if by_hand is None else sum(by_hand.values())
    chosen = by_xla if total is None else total
    peak = device.peak_flops_per_second()
    memory = bench.lower_update().compile().memory_analysis()
    results: dict[str, Any] = {
        "update_gflop": None if by_xla is None else by_xla / 1e9,
        "update_gflop_by_hand": None if total is None else total / 1e9,
        "encoder_share_percent": None,
        "matrix_product_gflops": peak / 1e9,
        "utilisation_percent": None,
        "utilisation_counts": "xla" if total is None else "by hand",
    }
    if by_hand is not None and total is not None:
        results["encoder_share_percent"] = 100.0 * by_hand["encoder"] / total
    if chosen is not None:
        results["utilisation_percent"] = 1e5 * chosen / update_ms / peak
    for name in ("temp", "argument", "output", "alias"):
        size = getattr(memory, f"{name}_size_in_bytes", None)
        results[f"update_{name}_mb"] = None if size is None else size / 1e6
    return results


def by_part(
    config: Config, frame_shape: tuple[int, ...], action_dim: int
) -> dict[str, int] | None:
    """Returns the update's operations counted by hand; None for DAC and SIL.

    Those two differentiate convolutions of their own, DAC twice: no simple count.

    Args:
      config: of the run.
      frame_shape: (H, W, 3), or (S,) for state vectors.
      action_dim: A.
    """
    if config.method in ("dac", "sil"):
        return None
    if config.observation == "pixels":
        encoder, representation_dim = flops.pixel_encoder(
            config.image_size,
            frame_shape[-1] * config.frame_stack,
            channels=tuple(config.encoder.channels),
            kernel_sizes=tuple(config.encoder.kernel_sizes),
            strides=tuple(config.encoder.strides),
        )
    else:
        representation_dim = config.hidden_dim
        encoder = (frame_shape[0] * representation_dim,)
    sizes = flops.Sizes(
        encoder, representation_dim, config.feature_dim, config.hidden_dim, action_dim
    )
    if config.method == "bc":
        return flops.cloning_update(sizes, config.cloning.batch_size)
    parts = flops.drqv2_update(sizes, config.batch_size)
    if config.method == "pdac":
        settings = config.discriminator
        parts["rewarder"] = flops.adversarial_update(
            sizes,
            flops.Discriminator(
                settings.batch_size, settings.hidden_dim, settings.sees_actions
            ),
        )
    return parts
